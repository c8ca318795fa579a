"""What changed between two calibrations of a rig, and whether it matters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import chdtrc

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.checking.comparison_points import (
    Through,
    alignment_of,
    for_each_point,
    points_through,
    rms,
    robust_weights,
    without_motion,
)
from sms_jobs.metrology.calibration.pair_points import Parameters, box_grid
from sms_jobs.metrology.calibration.rigid_alignment import rigid_modes
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR, SENSOR_PARAMETERS, Pose
from sms_jobs.metrology.geometry.transforms import compose, rotation_vector, transform

Relation: TypeAlias = Literal["independent", "updated", "lenses updated"]
Verdict: TypeAlias = Literal["unchanged", "harmless", "matters", "cannot tell"]

_CERTAIN = 4.0  # times the distance of points that is expected by chance
_LEAST_LEARNT = 0.01  # of a variance: directions in which an update learnt less are left out of the test
_ROUNDING = 1e-10
_LEAST: dict[Relation, float] = {"independent": _ROUNDING, "updated": _LEAST_LEARNT, "lenses updated": 1e-6}
"""Of the largest variance of a change: directions with less have none but for rounding."""


@dataclass(frozen=True)
class ParameterChange:
    """One parameter of a sensor.

    Attributes
    ----------
    sensor, parameter
        Names; see `SENSOR_PARAMETERS`.
    change
        After less before, in rad, mm or px; of the rotation, the small turn from before to after.
    sigma, z
        Standard deviation of such a change where nothing happened, and the change in units of it; NaN where
        it is not known, as for what was held fixed.
    """

    sensor: str
    parameter: str
    change: float
    sigma: float
    z: float


@dataclass(frozen=True)
class PairChange:
    """What a pair makes of the same pixels with both calibrations, over the volume.

    Attributes
    ----------
    camera, projector
        Names.
    points
        Places of the volume that both sensors see.
    rms_mm, largest_mm
        Distance of the points by the two calibrations, each in its own world.
    aligned_rms_mm, aligned_largest_mm
        After the rigid motion of `CalibrationComparison.alignment`, the same for all pairs: what changes of
        shapes.
    expected_rms_mm, expected_aligned_rms_mm
        What the covariances let expect where nothing happened; NaN without them.
    worst_place
        (X, Y, Z) in mm of the largest distance after alignment.
    """

    camera: str
    projector: str
    points: int
    rms_mm: float
    largest_mm: float
    aligned_rms_mm: float
    aligned_largest_mm: float
    expected_rms_mm: float
    expected_aligned_rms_mm: float
    worst_place: tuple[float, float, float]


@dataclass(frozen=True)
class CalibrationComparison:
    """What changed from one calibration to another.

    Attributes
    ----------
    verdict, reason
        "unchanged": the covariances explain it. "harmless": it is below the tolerance. "matters": it is
        above. "cannot tell": it is above, but so is what the covariances let expect. The reason names the
        sensor whose change alone explains most.
    changes
        Of all parameters of all sensors.
    pairs
        Of all pairs.
    alignment
        Brings points of the later world to those of the earlier: by least squares where chance explains the
        change, otherwise with the least sum of the pairs' rms distances, so that the pairs with a sensor that
        moved do not turn those without.
    turn_rad, shift_mm
        Size of the alignment: its angle, and how far it moves the middle of the volume.
    statistic, freedom, p_value
        Chi-square of the change of all parameters together, and the probability of a larger one where
        nothing happened; NaN without covariances.
    """

    verdict: Verdict
    reason: str
    changes: tuple[ParameterChange, ...]
    pairs: tuple[PairChange, ...]
    alignment: Pose
    turn_rad: float
    shift_mm: float
    statistic: float
    freedom: int
    p_value: float


def compare_calibrations(
    before: Mapping[str, Parameters],
    after: Mapping[str, Parameters],
    pairs: Sequence[tuple[str, str]],
    volume: tuple[Floats, Floats],
    *,
    covariance_before: Floats | None = None,
    covariance_after: Floats | None = None,
    relation: Relation = "independent",
    same_world: bool = True,
    tolerance_mm: float,
    false_alarm: float = 0.001,
) -> CalibrationComparison:
    """Say what changed between two calibrations, and whether it matters.

    Parameters
    ----------
    before, after
        Inner parameters and pose of every sensor, by name.
    pairs
        (camera, projector) that measure.
    volume
        Low and high corner, (3,) each in mm, in the world of `before`.
    covariance_before, covariance_after
        (p, p) of all parameters of all sensors in the order of `before`; both or none.
    relation
        Whether the later calibration is independent of the earlier, or began from it as prior knowledge:
        then the covariance of the change is the difference, not the sum (Kalman's update). "lenses updated":
        it took over what was known of the inner parameters, and found anew where the sensors stand.
    same_world
        Whether both are in one world by more than name. Otherwise the later one is brought into the world
        of the earlier by the best rigid motion of points, and what is left of changes is tested.
    tolerance_mm
        Change of points, rms over the volume after alignment, from which on it matters.
    false_alarm
        Probability that calibrations that differ by chance are said to differ.

    Raises
    ------
    InvalidInput
        When the sensors are not the same, a covariance is of another size, or no place is seen by a pair.
    """
    names = list(before)
    _check(before, after, covariance_before, covariance_after)
    through = [points_through(before, after, c, p, box_grid(*volume)) for c, p in pairs]
    spread = _spread(covariance_before, covariance_after, relation)
    test = _tested(before, after, through, [1.0] * len(through), spread, relation, same_world)
    if test.p_value < false_alarm:
        test = _tested(before, after, through, robust_weights(through), spread, relation, same_world)
    middle = 0.5 * (np.asarray(volume[0]) + np.asarray(volume[1]))
    found = _pair_changes(through, test.weights, test.alignment, spread)
    verdict, reason = _verdict(found, test.p_value, false_alarm, tolerance_mm)
    if test.p_value < false_alarm:
        suspect, part = _suspect(test.whitened, test.taking, names)
        reason += f"; a change of {suspect} alone explains {part:.0%} of what the covariances do not"
    return CalibrationComparison(
        verdict,
        reason,
        _changes(names, test.step, test.variance),
        found,
        test.alignment,
        float(np.linalg.norm(rotation_vector(test.alignment.matrix()))),
        float(np.linalg.norm(transform(test.alignment, middle) - middle)),
        float(np.sum(test.whitened**2)) if len(test.whitened) else float("nan"),
        len(test.whitened),
        test.p_value,
    )


def parameter_change(before: Parameters, after: Parameters) -> Floats:
    """Return after less before of the parameters of a sensor; R_after = exp([r]x) R_before."""
    turn = rotation_vector(after[1].matrix() @ before[1].matrix().T)
    shift = np.subtract(after[1].translation, before[1].translation)
    return np.concatenate([turn, shift, after[0].vector() - before[0].vector()])


def _check(
    before: Mapping[str, Parameters],
    after: Mapping[str, Parameters],
    covariance_before: Floats | None,
    covariance_after: Floats | None,
) -> None:
    if set(before) != set(after):
        odd = ", ".join(sorted(set(before) ^ set(after)))
        raise InvalidInput(f"only one of the calibrations has {odd}: compare those of the same sensors")
    if (covariance_before is None) != (covariance_after is None):
        raise InvalidInput("only one of the two calibrations has a covariance: give both or none")
    size = PER_SENSOR * len(before)
    for covariance in (covariance_before, covariance_after):
        if covariance is not None and covariance.shape != (size, size):
            raise InvalidInput(
                f"a covariance is {covariance.shape}, but {len(before)} sensors have {size} parameters: "
                f"give {size} x {size}"
            )


@dataclass(frozen=True)
class _Test:
    """The change of all parameters in one world, and what of it chance does not explain.

    The statistic does not depend on the motion that brings one world to the other, the rest does.
    """

    weights: Sequence[float]
    alignment: Pose
    step: Floats
    variance: Floats | None
    whitened: Floats
    taking: Floats
    p_value: float


def _tested(
    before: Mapping[str, Parameters],
    after: Mapping[str, Parameters],
    through: Sequence[Through],
    weights: Sequence[float],
    spread: Floats | None,
    relation: Relation,
    same_world: bool,
) -> _Test:
    alignment = alignment_of(through, weights)
    later = {n: after[n] if same_world else _carried(after[n], alignment) for n in before}
    step = np.concatenate([parameter_change(before[n], later[n]) for n in before])
    left = np.eye(len(step)) if same_world else without_motion(through, weights, list(before.values()))
    if spread is not None:
        spread = left @ spread @ left.T
    whitened, taking = _whitened(step, spread, relation, 0 if same_world else 6)
    p_value = float(chdtrc(len(whitened), np.sum(whitened**2))) if len(whitened) else float("nan")
    variance = None if spread is None else np.diag(spread)
    return _Test(weights, alignment, step, variance, whitened, taking @ left, p_value)


def _carried(sensor: Parameters, alignment: Pose) -> Parameters:
    """Return a sensor in the world into which `alignment` brings its own."""
    back = Pose.from_arrays(alignment.matrix().T, alignment.centre())
    return sensor[0], compose(sensor[1], back)


def _spread(before: Floats | None, after: Floats | None, relation: Relation) -> Floats | None:
    """Return the covariance of a change where nothing happened."""
    if before is None or after is None:
        return None
    if relation == "independent":
        return before + after
    if relation == "updated":
        return before - after
    shared = _shared(before, after)
    return before + after - shared - shared.T


def _shared(before: Floats, after: Floats) -> Floats:
    """Return the covariance of later with earlier parameters that have the lenses' prior in common.

    A later x = C_x (C_l^-1 l + new observations) follows the earlier lenses l by C_x[:, l] C_l^-1, and these
    have the covariance C[l, :] with all earlier parameters.
    """
    lens = np.flatnonzero((np.arange(len(before)) % PER_SENSOR >= PER_POSE) & (np.diag(before) > 0.0))
    sigma = np.sqrt(np.diag(before)[lens])
    own = before[np.ix_(lens, lens)] / np.outer(sigma, sigma)
    return np.asarray((after[:, lens] / sigma) @ np.linalg.solve(own, before[lens] / sigma[:, None]))


def _whitened(
    step: Floats, spread: Floats | None, relation: Relation, taken_out: int
) -> tuple[Floats, Floats]:
    """Return a change in the directions that its covariance has, in standard deviations, (k,), and what
    takes other changes of all p parameters there, (k, p); some directions may have been taken out.
    """
    free = np.zeros(len(step), np.bool_) if spread is None else np.diag(spread) > 0.0
    if spread is None or free.sum() <= taken_out:
        return np.empty(0), np.empty((0, len(step)))
    sigma = np.sqrt(np.diag(spread)[free])
    values, vectors = np.linalg.eigh(spread[np.ix_(free, free)] / np.outer(sigma, sigma))
    some = values > _LEAST[relation] * values[-1]
    some[:taken_out] = False
    taking = np.zeros((int(some.sum()), len(step)))
    taking[:, free] = vectors[:, some].T / np.sqrt(values[some])[:, None] / sigma
    return taking @ step, taking


def _suspect(whitened: Floats, taking: Floats, names: Sequence[str]) -> tuple[str, float]:
    """Return the sensor whose change alone explains most, and which part of the chi-square it does."""
    parts = []
    for i in range(len(names)):
        own, sizes, _ = np.linalg.svd(taking[:, PER_SENSOR * i : PER_SENSOR * (i + 1)], full_matrices=False)
        own = own[:, sizes > _ROUNDING * sizes[0]]
        parts.append(float(np.sum((own.T @ whitened) ** 2) / np.sum(whitened**2)))
    most = int(np.argmax(parts))
    return names[most], parts[most]


def _changes(names: Sequence[str], step: Floats, variance: Floats | None) -> tuple[ParameterChange, ...]:
    found = []
    for i, change in enumerate(step):
        known = variance is not None and variance[i] > 0.0
        sigma = float(np.sqrt(variance[i])) if variance is not None and known else float("nan")
        name, parameter = names[i // PER_SENSOR], SENSOR_PARAMETERS[i % PER_SENSOR]
        found.append(ParameterChange(name, parameter, float(change), sigma, float(change) / sigma))
    return tuple(found)


def _pair_changes(
    through: Sequence[Through], weights: Sequence[float], alignment: Pose, spread: Floats | None
) -> tuple[PairChange, ...]:
    modes = np.concatenate([rigid_modes(t.before) for t in through]).reshape(-1, 6)
    rows = np.concatenate([t.rows for t in through]).reshape(len(modes), -1)
    root = np.repeat(np.sqrt(for_each_point(through, weights)), 3)[:, None]
    left = rows - modes @ np.linalg.lstsq(root * modes, root * rows, rcond=None)[0]
    found, start = [], 0
    for t in through:
        plain = np.linalg.norm(t.after - t.before, axis=1)
        aligned = np.linalg.norm(transform(alignment, t.after) - t.before, axis=1)
        part = slice(start, start + 3 * len(plain))
        start = part.stop
        worst = t.before[np.argmax(aligned)]
        found.append(
            PairChange(
                t.camera,
                t.projector,
                len(plain),
                rms(plain),
                float(plain.max()),
                rms(aligned),
                float(aligned.max()),
                _expected(rows[part], spread),
                _expected(left[part], spread),
                (float(worst[0]), float(worst[1]), float(worst[2])),
            )
        )
    return tuple(found)


def _expected(rows: Floats, spread: Floats | None) -> float:
    """Return the expected rms distance of points whose coordinates have the derivatives `rows` (3 n, p)."""
    if spread is None:
        return float("nan")
    total = float(np.sum((rows @ spread) * rows))
    return float(np.sqrt(max(0.0, 3.0 * total / len(rows))))


def _verdict(
    pairs: tuple[PairChange, ...], p_value: float, false_alarm: float, tolerance: float
) -> tuple[Verdict, str]:
    worst = max(pairs, key=lambda p: p.aligned_rms_mm)
    name, moved = worst.camera + worst.projector, worst.aligned_rms_mm
    expected = worst.expected_aligned_rms_mm
    above = moved > tolerance
    said = f"points of {name} change by {moved:.3g} mm rms over the volume"
    if p_value >= false_alarm:
        if above and moved > _CERTAIN * expected:
            return "matters", (
                f"{said}, above the tolerance of {tolerance:g} mm, where {expected:.3g} mm come by chance: "
                "use the later calibration"
            )
        if above:
            return "cannot tell", (
                f"{said}, above the tolerance of {tolerance:g} mm, but {expected:.3g} mm come "
                "by chance: record more poses"
            )
        return "unchanged", f"{said}, as expected by chance ({expected:.3g} mm)"
    if above:
        return "matters", f"{said}, above the tolerance of {tolerance:g} mm: use the later calibration"
    return "harmless", f"{said}, below the tolerance of {tolerance:g} mm"
