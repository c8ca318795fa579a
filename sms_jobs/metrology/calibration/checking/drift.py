"""Whether a calibration still holds, from the ray gap of an ordinary measurement.

The rays of a pair that belong together meet, but for noise and for what the calibration left. A sensor that
has moved since opens a gap, which varies smoothly over the image and so stands out of the noise by averaging
over blocks of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, chndtrinc

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.checking.gap_blocks import GapBlocks, block_gaps
from sms_jobs.metrology.calibration.pair_points import Parameters, meet_rays, moved_sensor
from sms_jobs.metrology.calibration.sensor_derivatives import gap_derivatives
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR, project

Verdict: TypeAlias = Literal["holds", "drifted", "cannot tell"]

_FEWEST_BLOCKS = 12  # five more than the changes that are sought
_SEEN = 0.3  # of a plausible change: what is determined worse than that is left out of the explanation
_POWER = 0.95

CHANGES = (
    "turn of the projector about its x",
    "turn of the projector about its y",
    "turn of the projector about its z",
    "shift of the projector off the plane of base and specimen",
    "shift of the projector across the base in that plane",
    "relative change of the projector's focal length",
    "relative change of the camera's focal length",
)
"""Changes of a pair that may open a gap: three in rad, two in mm, two relative. A shift along the base and a
common motion of both sensors open none."""

UNITS = ("rad", "rad", "rad", "mm", "mm", "1", "1")


@dataclass(frozen=True)
class DriftOptions:
    """How drift is looked for.

    Attributes
    ----------
    false_alarm
        Probability that a calibration that holds is said to have drifted.
    block_px
        Side of the blocks of pixels over which gaps are averaged.
    plausible
        Of a turn in rad, of a shift in units of the base, and of a relative change of focal length.
    """

    false_alarm: float = 0.001
    block_px: int = 32
    plausible: float = 1e-3


@dataclass(frozen=True)
class Change:
    """One part of the explanation.

    Attributes
    ----------
    name, unit
        See `CHANGES` and `UNITS`.
    value, sigma
        Estimate and its standard deviation, of the part that the gap tells.
    determined
        Whether the gap tells it; otherwise it is mixed up with others, or the gap is blind to it.
    """

    name: str
    unit: str
    value: float
    sigma: float
    determined: bool


@dataclass(frozen=True)
class DriftCheck:
    """Whether a calibration holds, and what the gap says of a change.

    Attributes
    ----------
    verdict, reason
        And why, in a sentence.
    pixels, outliers, blocks
        Valid pixels, those left out of their block, and blocks that were used.
    false_alarm
        Probability of "drifted" for a calibration that holds.
    motion_statistic, motion_threshold, motion_freedom
        Chi-square of the gap pattern that changes of the pair explain.
    rest_statistic, rest_threshold, rest_freedom
        Of what they do not explain.
    gap_rms_mm
        Of the systematic gap: of the blocks' means, less their noise.
    largest_gap_mm, largest_gap_sigma_mm
        Of the block with the largest mean, signed, and its standard deviation.
    detectable_rms_mm
        Systematic gap, rms over the blocks, that would be found with a probability of 95 % whatever change
        makes it.
    explained
        Part of the blocks' squared gaps that the explanation takes away.
    changes
        The smallest change of the pair, in plausible units, that explains the gap.
    point_change_rms_mm, point_change_sigma_mm
        What it does to the measured points: rms, and standard deviation of that. Of places where nothing was
        measured the gap tells nothing: there the same explanation is an extrapolation, and beyond the images
        that of a lens's polynomial.
    """

    verdict: Verdict
    reason: str
    pixels: int
    outliers: int
    blocks: int
    false_alarm: float
    motion_statistic: float = float("nan")
    motion_threshold: float = float("nan")
    motion_freedom: int = 0
    rest_statistic: float = float("nan")
    rest_threshold: float = float("nan")
    rest_freedom: int = 0
    gap_rms_mm: float = float("nan")
    largest_gap_mm: float = float("nan")
    largest_gap_sigma_mm: float = float("nan")
    detectable_rms_mm: float = float("nan")
    explained: float = float("nan")
    changes: tuple[Change, ...] = ()
    point_change_rms_mm: float = float("nan")
    point_change_sigma_mm: float = float("nan")


@dataclass(frozen=True)
class _Fit:
    """Estimate (7,) in plausible units, its covariance, and the directions (7, k) that the gap determines."""

    estimate: Floats
    covariance: Floats
    directions: Floats
    statistic: float
    rest: float


def pair_changes(camera: Parameters, projector: Parameters, middle: Floats) -> Floats:
    """Return the parameters of a pair, (2 PER_SENSOR, 7), the camera's first, by unit of each of `CHANGES`.

    `middle` (3,) in mm is where the specimen is. The projector turns about its pin-hole, not about the
    world's origin: with T = -R c a turn r takes T along by r x T.
    """
    columns = np.zeros((2 * PER_SENSOR, 7))
    turned, shifted, focal, pose = PER_SENSOR, PER_SENSOR + 3, PER_SENSOR + PER_POSE, projector[1]
    for k in range(3):
        turn = np.eye(3)[k]
        columns[turned:shifted, k], columns[shifted:focal, k] = turn, np.cross(turn, pose.translation)
    base = pose.centre() - camera[1].centre()
    off = np.cross(base, middle - camera[1].centre())
    off /= np.linalg.norm(off)
    within = np.cross(off, base / np.linalg.norm(base))
    columns[shifted:focal, 3], columns[shifted:focal, 4] = -pose.matrix() @ off, -pose.matrix() @ within
    columns[focal : focal + 2, 5] = projector[0].fx, projector[0].fy
    columns[PER_POSE : PER_POSE + 2, 6] = camera[0].fx, camera[0].fy
    return columns


def check_drift(
    gap: NDArray[np.floating],
    xyz: NDArray[np.floating],
    camera: Parameters,
    projector: Parameters,
    *,
    gap_sigma: NDArray[np.floating] | None = None,
    baseline_rms_mm: float = 0.0,
    covariance: Floats | None = None,
    options: DriftOptions | None = None,
) -> DriftCheck:
    """Decide by the ray gap whether the calibration of a pair still holds.

    Parameters
    ----------
    gap
        (rows, columns) signed ray gap in mm, as `triangulate` gives it; NaN where invalid. Pixels must not
        have been refused for their gap, or a drift would hide itself.
    xyz
        (3, rows, columns) in mm, with the calibration that is checked.
    camera, projector
        That calibration.
    gap_sigma
        (rows, columns) in mm, from noise, as `triangulate` gives it; None to take it from the scatter.
    baseline_rms_mm
        Systematic gap that the calibration left when it was new: rms, noise taken out.
    covariance
        (p, p) of the pair's parameters, the camera's first: what the calibration did not know.
    options
        How.

    Notes
    -----
    Means m over blocks have the covariance S: their noise, J C J^T of the calibration, and the baseline b as
    b^2 in each block plus a pattern of rms b in each direction of what changes of the pair make: on the safe
    side, since it is not known which pattern the calibration left.
    The part of m^T S^-1 m that changes explain is chi-square with as many degrees of freedom as the gap
    tells, the rest chi-square with those that remain; both are tested, so that each has half of the
    probability of a false alarm. Where the rest is larger than its expectation, the explanation's variances
    are larger in the same ratio. Raises `InvalidInput` for maps that do not fit each other.
    """
    chosen = options or DriftOptions()
    if xyz.shape != (3, *gap.shape) or (gap_sigma is not None and gap_sigma.shape != gap.shape):
        raise InvalidInput(
            f"gap {gap.shape} and xyz {xyz.shape} are not of one image: give (rows, columns) and "
            "(3, rows, columns)"
        )
    blocks = block_gaps(gap, xyz, gap_sigma, chosen.block_px)
    count = len(blocks.gap)
    if count < _FEWEST_BLOCKS:
        reason = (
            f"{blocks.valid} valid pixels fill {count} blocks of {chosen.block_px} px, where "
            f"{_FEWEST_BLOCKS} are needed: measure something larger, or with smaller blocks"
        )
        return DriftCheck("cannot tell", reason, blocks.valid, blocks.outliers, count, chosen.false_alarm)
    derivatives = gap_derivatives(camera, projector, blocks.point)
    by_change = pair_changes(camera, projector, blocks.point.mean(axis=0))
    base = float(np.linalg.norm(projector[1].centre() - camera[1].centre()))
    unit = chosen.plausible * np.array([1.0, 1.0, 1.0, base, base, 1.0, 1.0])
    # The true parameters leave no gap and the stated ones lack the change, so the gap is -J change.
    patterns = -derivatives @ by_change * unit
    spread = _covariance(blocks, patterns, baseline_rms_mm)
    if covariance is not None:
        spread += derivatives @ covariance @ derivatives.T
    fit = _explain(blocks.gap, patterns, spread)
    return _judged(blocks, fit, patterns, spread, by_change * unit, unit, (camera, projector), chosen)


def _covariance(blocks: GapBlocks, patterns: Floats, baseline: float) -> Floats:
    """Return the covariance of the blocks' means from noise and from the calibration's own gap."""
    q, _ = np.linalg.qr(patterns)
    b = len(blocks.gap)
    smooth = baseline**2 * b * (q @ q.T)
    return np.asarray(np.diag(blocks.sigma**2 + baseline**2) + smooth)


def _explain(gap: Floats, patterns: Floats, spread: Floats) -> _Fit:
    """Fit the patterns (b, 7) to the means (b,), in the directions that they determine well enough."""
    root = np.linalg.cholesky(spread)
    a, m = np.linalg.solve(root, patterns), np.linalg.solve(root, gap)
    values, vectors = np.linalg.eigh(a.T @ a)
    seen = values > 1.0 / _SEEN**2
    directions, information = vectors[:, seen], values[seen]
    estimate = directions @ ((directions.T @ (a.T @ m)) / information)
    statistic = float(np.sum((directions.T @ (a.T @ m)) ** 2 / information))
    rest = float(m @ m) - statistic
    # A change that leaves more than is expected is not known as well as if it left nothing.
    excess = max(1.0, rest / (len(gap) - len(information)))
    covariance = excess * (directions / information) @ directions.T
    return _Fit(estimate, covariance, directions, statistic, rest)


def _detectable(patterns: Floats, spread: Floats, threshold: float) -> float:
    """Return the rms over blocks of the least detectable pattern that is found with 95 %."""
    needed = chndtrinc(threshold, patterns.shape[1], 1.0 - _POWER)
    q, _ = np.linalg.qr(patterns)
    weakest = np.linalg.eigvalsh(q.T @ np.linalg.solve(spread, q))[0]
    return float(np.sqrt(needed / (weakest * len(patterns))))


def _judged(
    blocks: GapBlocks,
    fit: _Fit,
    patterns: Floats,
    spread: Floats,
    by_unit: Floats,
    unit: Floats,
    pair: tuple[Parameters, Parameters],
    options: DriftOptions,
) -> DriftCheck:
    count, freedom = len(blocks.gap), fit.directions.shape[1]
    each = 1.0 - np.sqrt(1.0 - options.false_alarm)
    motion = float(chdtri(freedom, each)) if freedom else float("inf")
    rest = float(chdtri(count - freedom, each))
    largest = int(np.argmax(np.abs(blocks.gap)))
    detectable = _detectable(patterns @ fit.directions, spread, motion) if freedom else float("inf")
    moved_much, strange = fit.statistic > motion, fit.rest > rest
    gap_rms = float(np.sqrt(max(0.0, float(np.mean(blocks.gap**2 - blocks.sigma**2)))))
    verdict: Verdict = "drifted" if moved_much or strange else "holds" if freedom else "cannot tell"
    if moved_much:
        reason = (
            f"the rays miss each other by {gap_rms:.3g} mm rms, in a pattern that a change of the pair makes"
        )
    elif strange:
        reason = (
            f"the rays miss each other by {gap_rms:.3g} mm rms, in a pattern that no change of the pair makes"
        )
    elif freedom:
        reason = f"no systematic gap was found, and one of {detectable:.3g} mm rms would have been"
    else:
        reason = "the gap tells no change of the pair to a third of what is plausible: measure more pixels"
    left = blocks.gap - patterns @ fit.estimate
    rms, sigma = _point_change(fit, by_unit, pair, blocks.point)
    return DriftCheck(
        verdict,
        reason,
        blocks.valid,
        blocks.outliers,
        count,
        options.false_alarm,
        motion_statistic=fit.statistic,
        motion_threshold=motion,
        motion_freedom=freedom,
        rest_statistic=fit.rest,
        rest_threshold=rest,
        rest_freedom=count - freedom,
        gap_rms_mm=gap_rms,
        largest_gap_mm=float(blocks.gap[largest]),
        largest_gap_sigma_mm=float(blocks.sigma[largest]),
        detectable_rms_mm=detectable,
        explained=1.0 - float(np.sum(left**2) / np.sum(blocks.gap**2)),
        changes=_changes(fit, unit),
        point_change_rms_mm=rms,
        point_change_sigma_mm=sigma,
    )


def _changes(fit: _Fit, unit: Floats) -> tuple[Change, ...]:
    sigma = np.sqrt(np.diag(fit.covariance))
    seen = np.sum(fit.directions**2, axis=1) > 0.9
    return tuple(
        Change(name, u, float(fit.estimate[k] * unit[k]), float(sigma[k] * unit[k]), bool(seen[k]))
        for k, (name, u) in enumerate(zip(CHANGES, UNITS, strict=True))
    )


def _point_change(
    fit: _Fit, by_unit: Floats, pair: tuple[Parameters, Parameters], points: Floats
) -> tuple[float, float]:
    """Return how far points are moved by the change, rms in mm, and the standard deviation of that."""
    camera, projector = pair
    pixels = project(*camera, points), project(*projector, points)

    def shift(change: Floats) -> Floats:
        step = by_unit @ change
        moved = moved_sensor(camera, step[:PER_SENSOR]), moved_sensor(projector, step[PER_SENSOR:])
        now, _ = meet_rays(*moved, *pixels)
        return now - points

    moved = shift(fit.estimate)
    some = np.isfinite(moved).all(axis=1)
    if not some.any():
        return float("nan"), float("nan")
    rms = float(np.sqrt(np.mean(np.sum(moved[some] ** 2, axis=1))))
    # The columns of a root of the covariance are independent changes of one standard deviation.
    values, vectors = np.linalg.eigh(fit.covariance)
    each = [shift(v * np.sqrt(max(s, 0.0)))[some] for s, v in zip(values, vectors.T, strict=True)]
    return rms, float(np.sqrt(np.mean(np.sum(np.square(each), axis=(0, 2)))))
