"""What pairs make of places in the volume with two calibrations, and the motion between their worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.covariance import point_jacobian
from sms_jobs.metrology.calibration.pair_points import Parameters, meet_rays
from sms_jobs.metrology.calibration.rigid_alignment import align_points
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose, project
from sms_jobs.metrology.geometry.transforms import transform

_ROUNDING_MM = 1e-9  # distance below which points agree
_REWEIGHTINGS = 30


@dataclass(frozen=True)
class Through:
    """Points of one pair by both calibrations, and how the earlier ones move with all parameters."""

    camera: str
    projector: str
    before: Floats
    after: Floats
    rows: Floats


def points_through(
    before: Mapping[str, Parameters],
    after: Mapping[str, Parameters],
    camera: str,
    projector: str,
    grid: Floats,
) -> Through:
    """Return what a pair makes of places (n, 3) in mm that it sees; `InvalidInput` where it sees none."""
    names = list(before)
    pixels = project(*before[camera], grid), project(*before[projector], grid)
    moved, _ = meet_rays(after[camera], after[projector], *pixels)
    own = point_jacobian(before[camera], before[projector], grid)
    # Where a lens's distortion folds the image back, no ray is known, and neither is how it moves.
    seen = np.isfinite(moved).all(axis=1) & np.isfinite(own).all(axis=(1, 2))
    if seen.sum() < 3:
        raise InvalidInput(f"{camera}{projector} sees {seen.sum()} places of the volume: check its corners")
    rows = np.zeros((int(seen.sum()), 3, PER_SENSOR * len(names)))
    for k, name in enumerate((camera, projector)):
        at = PER_SENSOR * names.index(name)
        rows[:, :, at : at + PER_SENSOR] = own[seen][:, :, PER_SENSOR * k : PER_SENSOR * (k + 1)]
    return Through(camera, projector, grid[seen], moved[seen], rows)


def alignment_of(through: Sequence[Through], weights: Sequence[float]) -> Pose:
    """Return the motion of later points to earlier ones of least weighted squares; one weight a pair."""
    after, before = (np.concatenate([getattr(t, k) for t in through]) for k in ("after", "before"))
    return align_points(after, before, for_each_point(through, weights))


def for_each_point(through: Sequence[Through], weights: Sequence[float]) -> Floats:
    """Return the weight of each point, of those of the pairs."""
    return np.concatenate([np.full(len(t.before), w) for t, w in zip(through, weights, strict=True)])


def robust_weights(through: Sequence[Through]) -> list[float]:
    """Return the pairs' weights in the motion that leaves the least sum of their rms distances.

    The best of the motions of all pairs and of each pair alone, improved by iteratively reweighted least
    squares with weights 1 / rms (Weiszfeld's algorithm, with pairs for points).
    """

    def left(weights: Sequence[float]) -> list[float]:
        motion = alignment_of(through, weights)
        return [rms(np.linalg.norm(transform(motion, t.after) - t.before, axis=1)) for t in through]

    starts = [np.ones(len(through)), *np.eye(len(through))]
    distances = min((left(start.tolist()) for start in starts), key=sum)
    for _ in range(_REWEIGHTINGS):
        weights = [1.0 / max(d, _ROUNDING_MM) for d in distances]
        distances = left(weights)
    return weights


def without_motion(
    through: Sequence[Through], weights: Sequence[float], sensors: Sequence[Parameters]
) -> Floats:
    """Return what takes the best rigid motion of points out of a change of all p parameters, (p, p).

    A motion X' = X + w x X + v of the world turns a sensor by -R w from the left and shifts it by -R v.
    """
    motion = np.zeros((PER_SENSOR * len(sensors), 6))
    for i, (_, pose) in enumerate(sensors):
        at = PER_SENSOR * i
        motion[at : at + 3, :3] = motion[at + 3 : at + 6, 3:] = -pose.matrix()
    root = np.sqrt(for_each_point(through, weights))[:, None, None]
    flat = (root * np.concatenate([t.rows for t in through])).reshape(-1, len(motion))
    return np.asarray(np.eye(len(motion)) - motion @ np.linalg.lstsq(flat @ motion, flat, rcond=None)[0])


def rms(values: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))
