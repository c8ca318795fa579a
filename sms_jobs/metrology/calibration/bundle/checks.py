"""Questions that a bundle adjustment must pass: before it begins, when it stands, and of what it found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.covariance import point_jacobian
from sms_jobs.metrology.calibration.bundle.normal_equations import Live, Packed
from sms_jobs.metrology.calibration.bundle.parameters import Freedom, State, adjusted_sensor, sensor_arrays
from sms_jobs.metrology.calibration.bundle.problem import BundleProblem
from sms_jobs.metrology.calibration.bundle.residuals import ray_distances
from sms_jobs.metrology.calibration.bundle.result import Nuisance, Rms
from sms_jobs.metrology.calibration.bundle.weak_directions import described, weakest_direction
from sms_jobs.metrology.calibration.estimates import Estimated
from sms_jobs.metrology.calibration.pair_points import box_grid
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR, SENSOR_PARAMETERS, Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.small_systems import inverse

_MOST_RELATIVE = 0.01
"""Of a focal length, and of a principal point over the focal length: beyond it nothing is linear."""

_DOUBTED_ALONE = 0.002
"""A fifth of that, as of points: of a focal length where no pair measures points that could be judged."""

_REFUSED_PART, _DOUBTED_PART = 1e-3, 2e-4
"""Of the volume's diagonal, for the standard deviation of a point in the shape of things, scale apart; the
doubted one is the thesis's 1/5000."""

_STEPS_INWARDS = 40
"""From a corner of the volume to its middle."""

_SINGULAR = 1e13
_MOST_Z = 4.0
_LOOKED_AT = 25


def check_before(problem: BundleProblem, packed: Packed) -> None:
    """Raise `CalibrationFailed` for sensors without a common pose, no scale, or spheres that are swapped."""
    _check_labels(problem, packed)
    if all(set(s.fixed) == set(SENSOR_PARAMETERS) for s in problem.sensors):
        return  # the artefacts alone are measured
    if problem.prior is not None:
        known = np.diag(problem.prior.information).reshape(-1, PER_SENSOR)[:, :PER_POSE]
        if np.all(known > 0.0):
            return  # the sensors stand to each other about as they did
    _check_connected(problem)
    boards = bool(problem.board_points)
    both = any({1, 2} <= set(np.unique(p.sphere)) for p in problem.bar_points)
    if not boards and not both:
        raise CalibrationFailed(
            "nothing observed has a known length: no pose shows both spheres of a bar, none a board; add "
            "poses of a ball bar or of a board"
        )


def _check_connected(problem: BundleProblem) -> None:
    """Raise where sensors fall into groups that share no pose."""
    poses: dict[tuple[str, int], set[int]] = {}
    for seen in problem.bar_points:
        poses.setdefault(("bar", seen.pose), set()).update((seen.camera, seen.projector))
    for points in problem.board_points:
        poses.setdefault(("board", points.pose), set()).add(points.sensor)
    groups: list[set[int]] = []
    for members in poses.values():
        joined = set(members)
        for group in [g for g in groups if g & joined]:
            joined |= group
            groups.remove(group)
        groups.append(joined)
    names = [s.name for s in problem.sensors]
    lonely = set(range(len(names))) - set().union(*groups) if groups else set(range(len(names)))
    if lonely:
        raise CalibrationFailed(
            f"nothing was observed with {', '.join(names[i] for i in sorted(lonely))}: record poses "
            "that it sees"
        )
    if len(groups) > 1:
        parts = [", ".join(names[i] for i in sorted(g)) for g in sorted(groups, key=min)]
        raise CalibrationFailed(
            f"{' and '.join(parts)} share no pose, so their relative position is unknown: record "
            "poses that sensors of both see"
        )


def _check_labels(problem: BundleProblem, packed: Packed) -> None:
    """Raise where the points labelled as one sphere lie on the other."""
    sensors = sensor_arrays(tuple((s.intrinsics, s.pose) for s in problem.sensors))
    for block in packed.bars:
        held = problem.bar_poses[block.pose]
        if not np.all(np.isfinite(held.centres)):
            continue
        step = max(1, (block.stop - block.start) // _LOOKED_AT)
        seen = packed.bar_observed[block.start : block.stop : step, :4].reshape(-1, 2, 2)
        radius = problem.bars[held.bar].radius_mm
        own = _median_off(sensors, block.sensors, seen, held.centres[block.sphere], radius)
        if own <= 2.0 * radius:
            continue
        other = _median_off(sensors, block.sensors, seen, held.centres[1 - block.sphere], radius)
        if other < 0.25 * own:
            pair = "".join(problem.sensors[s].name for s in block.sensors)
            raise CalibrationFailed(
                f"the spheres of pose {held.name} are swapped in pair {pair}: points labelled "
                f"{block.sphere + 1} lie {own:.1f} mm off that sphere and {other:.1f} mm off the other; "
                "exchange the labels, or leave the pose out"
            )


def _median_off(
    sensors: tuple[Floats, Floats, Floats],
    pair: tuple[int, int],
    seen: Floats,
    centre: Floats,
    radius_mm: float,
) -> float:
    """Return how far points lie off a sphere, in mm, in the median over what a pair has seen, (n, 2, 2)."""
    sphere = np.append(centre, radius_mm)
    return float(np.nanmedian([abs(ray_distances(*sensors, pair, pixels, sphere)[1]) for pixels in seen]))


def check_counts(problem: BundleProblem, packed: Packed, live: Live, freedom: Freedom) -> None:
    """Raise `CalibrationFailed` for a sensor that has fewer than two residuals for each free parameter."""
    count = np.zeros(len(problem.sensors), np.int64)
    for block in packed.bars:
        count[list(block.sensors)] += 2 * int(live.bar[block.start : block.stop].sum())
    for block in packed.boards:
        count[block.sensors[0]] += 2 * int(live.board[block.start : block.stop].sum())
    for i, sensor in enumerate(problem.sensors):
        free = int(freedom.free[PER_SENSOR * i : PER_SENSOR * (i + 1)].sum())
        if count[i] < 2 * free and problem.prior is None:
            raise CalibrationFailed(
                f"{sensor.name} has {count[i]} residuals for {free} free parameters, at least {2 * free} are "
                "needed: record more poses that it sees, or fix some of its parameters"
            )


@dataclass(frozen=True)
class Determined:
    """What an adjustment's normal equations say of its own worth.

    Attributes
    ----------
    covariance
        Of all parameters.
    shape_mm
        Largest of all pairs' rms standard deviations of a point, but for motions and the scale of the whole.
    scale
        Relative standard deviation of the scale, of the pair that knows it worst; 0 where nothing is free.
    warnings
        Where a point is doubtful.
    """

    covariance: Floats
    shape_mm: float = 0.0
    scale: float = 0.0
    warnings: tuple[str, ...] = ()


def check_determined(
    problem: BundleProblem, state: State, freedom: Freedom, normal: Floats, added: Floats | None = None
) -> Determined:
    """Raise `CalibrationFailed` where a direction of the sensors' parameters is open, and name it.

    Parameters
    ----------
    normal
        Of the free parameters; its inverse is their covariance.
    added
        What comes on top of that covariance.
    """
    count = PER_SENSOR * len(problem.sensors)
    places = np.flatnonzero(freedom.free[:count])

    def words() -> str:
        return weakest_in_words(problem, freedom, normal)

    found = inverse(normal)
    if found is None or np.max(np.diag(found) * np.diag(normal)) > _SINGULAR:
        raise CalibrationFailed(f"the observations leave the calibration open: {words()}")
    covariance = freedom.unfold_covariance(found if added is None else found + added)
    part, which = _worst_lens(problem, state, covariance, ("fx", "fy", "cx", "cy"))
    if part > _MOST_RELATIVE:
        raise CalibrationFailed(
            f"{which} would be uncertain by {part:.1%} of its focal length (limit {_MOST_RELATIVE:.0%}): "
            + words()
        )
    if not len(places):
        return Determined(covariance)
    worst, scale, pair, diagonal = _worst_point(problem, state, covariance[:count, :count])
    if not pair:
        part, which = _worst_lens(problem, state, covariance, ("fx", "fy"))
        if part > _DOUBTED_ALONE:
            uncertain = f"{which} is uncertain by {part:.2%} of its focal length"
            told = f"{uncertain} (wanted {_DOUBTED_ALONE:.1%}): {words()}"
            return Determined(covariance, warnings=(told,))
    if worst <= _DOUBTED_PART * diagonal:
        return Determined(covariance, worst, scale)
    finding = (
        f"a point of the volume would be uncertain by {worst:.3g} mm with {pair}, 1/{diagonal / worst:.0f} "
        f"of the volume's diagonal of {diagonal:.0f} mm, scale apart"
    )
    if worst > _REFUSED_PART * diagonal:
        raise CalibrationFailed(f"{finding} (limit 1/{1 / _REFUSED_PART:.0f}): {words()}")
    warning = f"{finding} (wanted 1/{1 / _DOUBTED_PART:.0f}): {words()}"
    return Determined(covariance, worst, scale, (warning,))


def _worst_lens(
    problem: BundleProblem, state: State, covariance: Floats, names: tuple[str, ...]
) -> tuple[float, str]:
    """Return the largest deviation of some parameters in px, over the focal length, and which that is."""
    worst, named = 0.0, ""
    for i, sensor in enumerate(problem.sensors):
        for name in names:
            k = SENSOR_PARAMETERS.index(name)
            variance = covariance[PER_SENSOR * i + k, PER_SENSOR * i + k]
            part = float(np.sqrt(max(variance, 0.0))) / state.lens[i, k % 2]
            if part > worst:
                worst, named = part, f"{name} of {sensor.name}"
    return worst, named


def weakest_in_words(problem: BundleProblem, freedom: Freedom, normal: Floats) -> str:
    """Say what the observations tell least of, and what to add."""
    places = np.flatnonzero(freedom.free[: PER_SENSOR * len(problem.sensors)])
    if not len(places):
        return "all sensors are fixed; look at the artefacts' poses"
    direction = weakest_direction(normal, np.arange(len(places)))
    return described(direction, places, tuple(s.name for s in problem.sensors)) + _flatness(problem)


def _worst_point(problem: BundleProblem, state: State, covariance: Floats) -> tuple[float, float, str, float]:
    """Return `shape_mm` and `scale` of `Determined`, the pair of the first, and the volume's diagonal.

    Over a grid in the volume, but for motions of the whole: where the world is does not matter here. Nor does
    its scale, which no pose tells: it is as good as the pitch or the bar that it was taken from. What both
    sensors do not see of the volume is not judged: see `_in_sight`.
    """
    low, high = problem.volume if problem.volume is not None else observed_box(problem, state)
    worst, named, scale = 0.0, "", 0.0
    for pair in sorted(_pairs(problem)):
        first, second = (adjusted_sensor(problem.sensors[i], state, i) for i in pair)
        sizes = problem.sensors[pair[0]].size_px, problem.sensors[pair[1]].size_px
        grid = _in_sight((first, second), sizes, low, high)
        rows = point_jacobian(first, second, grid)
        seen = np.all(np.isfinite(rows), axis=(1, 2))
        if seen.sum() < 4:
            continue
        still, across = _without_motion(grid[seen], rows[seen].reshape(-1, 2 * PER_SENSOR))
        index = np.concatenate([np.arange(PER_SENSOR * i, PER_SENSOR * (i + 1)) for i in pair])
        own = covariance[np.ix_(index, index)]
        variance = np.sum((across @ own) * across) / seen.sum()
        sigma = float(np.sqrt(max(variance, 0.0)))
        scale = max(scale, float(np.sqrt(max(still @ own @ still, 0.0))))
        if sigma > worst:
            worst, named = sigma, "".join(problem.sensors[i].name for i in pair)
    return worst, scale, named, float(np.linalg.norm(np.subtract(high, low)))


def _in_sight(
    pair: Sequence[tuple[Intrinsics, Pose]], sizes: Sequence[tuple[int, int]], low: Floats, high: Floats
) -> Floats:
    """Return a grid (27, 3) in a box, each point moved towards the middle until both images show it.

    NaN where even the middle is not seen. A box has corners at which nothing was shown and that no camera
    sees; what a calibration would make of them no measurement asks.
    """
    whole, middle = box_grid(low, high, 3), 0.5 * (np.asarray(low) + np.asarray(high))
    grid = np.full_like(whole, np.nan)
    for part in np.linspace(1.0, 0.0, _STEPS_INWARDS + 1):
        tried = middle + part * (whole - middle)
        seen = np.isnan(grid[:, 0])
        for sensor, size in zip(pair, sizes, strict=True):
            pixel = project(*sensor, tried)
            seen &= ((pixel >= -0.5) & (pixel <= np.array(size) - 0.5)).all(axis=1)
        grid[seen] = tried[seen]
    return grid


def _without_motion(points: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Return changes of scale (k,), and changes of points (3 n, k) less rigid motion and scale in each."""
    centred = points - points.mean(axis=0)
    x, y, z = centred.T
    nothing, one = np.zeros_like(x), np.ones_like(x)
    turns = [[nothing, -z, y], [z, nothing, -x], [-y, x, nothing]]
    shifts = [[one, nothing, nothing], [nothing, one, nothing], [nothing, nothing, one]]
    basis, _ = np.linalg.qr(np.stack([np.stack(m, axis=1).ravel() for m in turns + shifts], axis=1))
    rest = rows - basis @ (basis.T @ rows)
    radial = centred.ravel()
    scale = radial @ rest / (radial @ radial)
    return np.asarray(scale), np.asarray(rest - np.outer(radial, scale))


def _pairs(problem: BundleProblem) -> set[tuple[int, int]]:
    """Return the pairs of sensors that see the same pose."""
    pairs = {(p.camera, p.projector) for p in problem.bar_points}
    if pairs:
        return pairs
    for a in problem.board_points:
        for b in problem.board_points:
            if a.pose == b.pose and a.sensor < b.sensor and not a.projector:
                pairs.add((a.sensor, b.sensor))
    return pairs


def observed_box(problem: BundleProblem, state: State) -> tuple[Floats, Floats]:
    """Return the corners of the box around all that was observed, no side below half of the longest."""
    points = [state.sphere[:, :, :3].reshape(-1, 3)]
    for seen in problem.board_points:
        board = state.board[seen.pose]
        if board[1, 4]:
            points.append(state.in_space(seen.point, seen.pose) @ board[:, :3].T + board[:, 3])
        else:
            points.append(seen.point @ board[:, :3].T * board[0, 4] + board[:, 3])
    everything = np.concatenate(points)
    everything = everything[np.all(np.isfinite(everything), axis=1)]
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = np.maximum(0.5 * (high - low), 0.25 * np.max(high - low))
    return 0.5 * (low + high) - half, 0.5 * (low + high) + half


def _flatness(problem: BundleProblem) -> str:
    """Say so when all spheres lie in one plane, from where they start: an open fit may have bent it."""
    seen = {p.pose for p in problem.bar_points}
    centres = np.array([problem.bar_poses[k].centres for k in sorted(seen)]).reshape(-1, 3)
    centres = centres[np.all(np.isfinite(centres), axis=1)]
    if len(centres) < 4:
        return ""
    extent = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False) / np.sqrt(len(centres))
    if extent[2] > 0.02 * extent[0]:
        return ""
    return f" (all spheres lie within {extent[2]:.2g} mm rms of one plane)"


def prior_warnings(nuisance: tuple[Nuisance, ...]) -> tuple[str, ...]:
    """Warn of certified lengths that the observations contradict."""
    loud = [n for n in nuisance if abs(n.z) > _MOST_Z]
    found = []
    lengths = [n for n in loud if n.what is Estimated.LENGTH]
    pitches = [n for n in loud if n.what is Estimated.PITCH_SCALE]
    reported = {*lengths, *pitches} if lengths and pitches else set()
    for length in lengths:
        for pitch in pitches:
            z = max(abs(length.z), abs(pitch.z))
            found.append(
                f"the length of {length.prior:.6g} mm of {length.artefact} and "
                f"the pitch of {pitch.artefact} disagree by {z:.0f} "
                f"sigma (limit {_MOST_Z:.0f}): together they make the bar {length.value:.6g} mm long and the "
                f"pitch {pitch.value:.6g} times what is stated; measure both again"
            )
    for n in loud:
        if n not in reported:
            unit = " mm" if n.unit == "mm" else ""
            found.append(
                f"the {n.name} is stated as {n.prior:.6g}{unit} within {n.prior_sigma:.2g}{unit} and found "
                f"to be {n.value:.6g}{unit}, {abs(n.z):.0f} sigma off (limit {_MOST_Z:.0f}): check what was "
                "stated"
            )
    return tuple(found)


def pose_warnings(
    problem: BundleProblem, packed: Packed, live: Live, rms: tuple[Rms, ...]
) -> tuple[str, ...]:
    """Warn of poses that fit three times as badly as all together, or lose most of their points."""
    found = []
    everything = {r.type: r for r in rms if r.of == "all"}
    for row in rms:
        usual = everything[row.type].whitened
        if row.of == "pose" and row.count >= 20 and row.whitened > 3.0 * usual:
            found.append(
                f"pose {row.name} fits badly: {row.type} {row.rms:.3g} {row.unit} rms, "
                f"{row.whitened / usual:.1f} times that of all poses; look at it, or leave it out"
            )
    for block in packed.bars:
        kept = float(live.bar[block.start : block.stop].mean()) if block.stop > block.start else 1.0
        if kept < 0.5:
            pair = "".join(problem.sensors[s].name for s in block.sensors)
            found.append(
                f"pose {problem.bar_poses[block.pose].name}, pair {pair}, sphere {block.sphere + 1}: only "
                f"{kept:.0%} of the points fit; is it the right sphere?"
            )
    for block in packed.boards:
        kept = float(live.board[block.start : block.stop].mean()) if block.stop > block.start else 1.0
        if kept < 0.5:
            found.append(
                f"pose {problem.board_poses[block.pose].name}: only {kept:.0%} of the board's points fit in "
                f"{problem.sensors[block.sensors[0]].name}"
            )
    if problem.world_board is not None:
        seeing = {p.sensor for p in problem.board_points if p.pose == problem.world_board}
        if len(seeing) < min(2, len(problem.sensors)):
            who = ", ".join(problem.sensors[s].name for s in seeing) or "no sensor"
            found.append(
                f"the {problem.gauge}, which is the world, is seen by {who} alone: choose a pose "
                "that more of them see"
            )
    return tuple(found)
