"""The rigid motion that brings points nearest to others."""

from __future__ import annotations

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose


def align_points(source: Floats, target: Floats, weights: Floats | None = None) -> Pose:
    """Return the rigid motion that brings points (n, 3) nearest to others (n, 3), by least squares.

    Arun et al. 1987, with the sign of Umeyama 1991, so that it is never a mirror. Weights (n,) of the squared
    distances are equal if not given. Raises `InvalidInput` for fewer than 3 points.
    """
    if source.shape != target.shape or len(source) < 3:
        raise InvalidInput(
            f"points {source.shape} and {target.shape} cannot be aligned: give 3 pairs or more"
        )
    share = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    here, there = share @ source, share @ target
    u, _, v = np.linalg.svd((target - there).T @ (share[:, None] * (source - here)))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return Pose.from_arrays(rotation, there - rotation @ here)


def rigid_modes(points: Floats) -> Floats:
    """Return the motion of points (n, 3) by a small turn (rad) and shift (mm): (n, 3, 6)."""
    rows = np.zeros((len(points), 3, 6))
    x, y, z = points.T
    rows[:, 0, 1], rows[:, 0, 2], rows[:, 1, 2] = z, -y, x
    rows[:, 1, 0], rows[:, 2, 0], rows[:, 2, 1] = -z, y, -x
    rows[:, :, 3:] = np.eye(3)
    return rows
