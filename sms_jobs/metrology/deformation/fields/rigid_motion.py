"""The motion that a piece of a specimen makes as a rigid body, and displacement without it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.calibration.rigid_alignment import align_points, rigid_modes
from sms_jobs.metrology.geometry.transforms import pack, rotation_vector

_FEWEST = 100
_FEWEST_TILES = 5
_THIN = 1e-3  # of its length: what is thinner tells no turn about itself
_ROUNDS = 3
_ROUNDING = 1e-9
_OUTLIER = 4.5  # times the median: at most two good pixels of a thousand are farther off, in any direction


@dataclass(frozen=True)
class RigidMotion:
    """A rigid motion x -> R (x - c) + c + t of points about their middle c.

    Attributes
    ----------
    middle
        c, (3,).
    rotation, shift
        R, (3, 3), and t, (3,).
    covariance
        (6, 6) of a small turn about the axes of the world at the middle (rad), and of the shift.
    rms
        Of the lengths of what is left.
    used
        (n,), which points took part.
    """

    middle: Floats
    rotation: Floats
    shift: Floats
    covariance: Floats
    rms: float
    used: Mask

    def displacement(self, position: Floats) -> Floats:
        """Return the displacement (3, ...) that points (3, ...) have by it."""
        arm = position - _column(self.middle, position)
        turned = np.tensordot(self.rotation, arm, axes=1)
        return np.asarray(turned - arm + _column(self.shift, position))

    def covariance_at(self, position: Floats) -> Floats:
        """Return the covariance that its own gives to displacements at points (3, ...), (6, ...)."""
        arm = self.modes(position.reshape(3, -1).T)
        return pack(arm @ self.covariance @ arm.transpose(0, 2, 1)).reshape(6, *position.shape[1:])

    def modes(self, points: Floats) -> Floats:
        """Return the motion of points (n, 3) by a small turn about its middle and a shift, (n, 3, 6)."""
        return rigid_modes((points - self.middle) @ self.rotation.T)


def rigid_motion(points: Floats, displacement: Floats, variance: Floats, tiles: Ints) -> RigidMotion:
    """Return the rigid motion nearest to a displacement, without what is far off it.

    Parameters
    ----------
    points, displacement
        (n, 3), in one unit of length.
    variance
        (n,), of the displacements, whose inverse is their weight.
    tiles
        (n,), which part of the region each is from.

    Raises
    ------
    InvalidInput
        They are too few, or lie on a line.

    Notes
    -----
    Least squares as in `align_points`. The covariance is that of the tile-wise jackknife (Miller 1974): each
    tile is left out in turn, so that what the region deforms counts as well as noise.
    """
    if len(points) < _FEWEST or len(np.unique(tiles)) < _FEWEST_TILES:
        raise InvalidInput(
            f"the region has {len(points)} pixels with a displacement in {len(np.unique(tiles))} of 16 parts "
            f"of it, and {_FEWEST} in {_FEWEST_TILES} are needed; choose a larger one"
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not spread[1] > _THIN * spread[0]:
        raise InvalidInput(
            "the region is a line, which does not show a turn about itself; choose a wider one"
        )
    least = 1e-12 * float(np.median(variance)) + 1e-30
    ends, weights = points + displacement, 1.0 / np.maximum(variance, least)
    used = np.ones(len(points), dtype=bool)
    for _ in range(_ROUNDS):
        pose = align_points(points[used], ends[used], weights[used])
        left = np.linalg.norm(ends - (points @ pose.matrix().T + pose.translation), axis=1)
        used = left <= max(_OUTLIER * float(np.median(left[used])), _ROUNDING)
    share = weights[used] / weights[used].sum()
    middle = share @ points[used]
    whole = _motion_of(points[used], ends[used], weights[used], middle)
    each = []
    for tile in np.unique(tiles[used]):
        rest = tiles[used] != tile
        other = _motion_of(points[used][rest], ends[used][rest], weights[used][rest], middle)
        each.append([*rotation_vector(other[0] @ whole[0].T), *(other[1] - whole[1])])
    off = np.array(each) - np.mean(each, axis=0)
    covariance = (len(off) - 1) / len(off) * off.T @ off
    found = RigidMotion(middle, *whole, covariance, 0.0, used)
    remainder = displacement[used] - found.displacement(points[used].T).T
    rms = float(np.sqrt(np.mean(np.sum(remainder**2, axis=1))))
    return RigidMotion(middle, *whole, covariance, rms, used)


def _motion_of(points: Floats, ends: Floats, weights: Floats, middle: Floats) -> tuple[Floats, Floats]:
    """Return rotation and shift of the motion about a middle."""
    pose = align_points(points, ends, weights)
    return pose.matrix(), pose.matrix() @ middle + pose.translation - middle


def common_factor(motion: RigidMotion, points: Floats, factor: Floats) -> Floats:
    """Return by how much a motion changes with each column of a factor (n, 3, r) of points (n, 3), (6, r)."""
    seen = np.isfinite(factor).all(axis=(1, 2))
    rows = motion.modes(points[seen]).reshape(-1, 6)
    return np.asarray(np.linalg.pinv(rows) @ factor[seen].reshape(-1, factor.shape[2]))


def with_motion(packed: NDArray[np.floating] | None, own: Floats) -> Singles:
    """Return a packed covariance (6, ...) with that of a motion added; that alone where there is none."""
    total = own if packed is None else np.asarray(packed, dtype=np.float64) + own
    return np.asarray(total.astype(np.float32))


def _column(vector: Floats, like: Floats) -> Floats:
    return vector.reshape(3, *([1] * (like.ndim - 1)))
