"""Rigid transforms: rotations by vector and by angles, poses composed and inverted, covariances turned."""

from __future__ import annotations

from math import cos, sin

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose

PACKED = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Row and column of each of the six components of a packed symmetric 3 x 3 tensor."""


def rotation_matrix(vector: Floats) -> Floats:
    """Return the (..., 3, 3) rotation about a (..., 3) vector by its length in rad (Rodrigues)."""
    flat = np.asarray(vector, dtype=np.float64).reshape(-1, 3)
    return np.asarray(Rotation.from_rotvec(flat).as_matrix()).reshape(*np.shape(vector)[:-1], 3, 3)


def rotation_vector(matrix: Floats) -> Floats:
    """Return the (3,) vector, of length 0 .. pi in rad, of a (3, 3) rotation."""
    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


def rotation_from_angles(omega: float, phi: float, kappa: float) -> Floats:
    """Return the (3, 3) rotation of photogrammetric angles in rad.

    Thesis Eq. (1.24), with -cos(phi) sin(kappa) at the beginning of row 2, where -cos(phi) cos(kappa) is
    printed: about x by -omega, then about y by -phi, then about z by -kappa.
    """
    so, co, sp, cp, sk, ck = sin(omega), cos(omega), sin(phi), cos(phi), sin(kappa), cos(kappa)
    return np.array(
        [
            [cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck],
            [-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk],
            [sp, -so * cp, co * cp],
        ]
    )


def transform(pose: Pose, points: Floats) -> Floats:
    """Return R x + T of points (..., 3) in mm."""
    return np.asarray(points @ pose.matrix().T + np.array(pose.translation))


def inverse(pose: Pose) -> Pose:
    """Return the transform that undoes another: R_ba, T_ba from R_ab, T_ab."""
    return Pose.from_arrays(pose.matrix().T, pose.centre())


def compose(outer: Pose, inner: Pose) -> Pose:
    """Return the transform that applies `inner` first and `outer` to its result: a from c by a-b and b-c."""
    rotation = outer.matrix() @ inner.matrix()
    return Pose.from_arrays(rotation, outer.matrix() @ np.array(inner.translation) + outer.translation)


def unpack(packed: NDArray[np.floating]) -> Floats:
    """Return the full tensors, (..., 3, 3), of components packed along the first axis, (6, ...)."""
    full = np.empty((*packed.shape[1:], 3, 3))
    for component, (i, j) in zip(packed, PACKED, strict=True):
        full[..., i, j] = full[..., j, i] = component
    return full


def pack(full: Floats) -> Floats:
    """Return (6, ...) components of symmetric tensors (..., 3, 3), in the order XX, XY, XZ, YY, YZ, ZZ."""
    return np.stack([full[..., i, j] for i, j in PACKED])


def turn_covariance(rotation: Floats, packed: NDArray[np.floating]) -> Floats:
    """Return R C R^T of packed covariances (6, ...), for one rotation (3, 3)."""
    return pack(rotation @ unpack(packed) @ rotation.T)
