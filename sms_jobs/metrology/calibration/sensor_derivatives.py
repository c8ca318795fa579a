"""How images of points, and the gap of a pair's rays, change with the parameters of the sensors."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR, Pose
from sms_jobs.metrology.geometry.lens import Intrinsics, distort, distortion_jacobian, pixel_jacobian
from sms_jobs.metrology.geometry.transforms import transform


def _cross_matrix(vectors: Floats) -> Floats:
    """Return [v]x of vectors (n, 3): [v]x w = v x w."""
    rows = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    rows[:, 0, 1], rows[:, 0, 2], rows[:, 1, 2] = -z, y, -x
    rows[:, 1, 0], rows[:, 2, 0], rows[:, 2, 1] = z, -y, x
    return rows


def project_with_derivatives(
    intrinsics: Intrinsics, pose: Pose, points: Floats
) -> tuple[Floats, Floats, Floats]:
    """Project points and say how their images move.

    Parameters
    ----------
    intrinsics, pose
        Of the sensor.
    points
        (n, 3) in mm.

    Returns
    -------
    Pixels (n, 2), d(pixel)/d(rx, ry, rz, tx, ty, tz) (n, 2, 6) for R <- exp([r]x) R and T <- T + t, and
    `pixel_jacobian` (n, 2, parameters of the lens). NaN for points at or behind the pin-hole's plane.

    Notes
    -----
    Derivatives of thesis Eq. (1.7)-(1.12) and (1.21)-(1.23).
    """
    inside = transform(pose, points)
    turned = inside - np.array(pose.translation)
    z = np.where(inside[:, 2] > 0.0, inside[:, 2], np.nan)
    normalised = inside[:, :2] / z[:, None]
    focal = np.array([intrinsics.fx, intrinsics.fy])
    to_normalised = np.zeros((len(points), 2, 3))
    to_normalised[:, 0, 0] = to_normalised[:, 1, 1] = 1.0 / z
    to_normalised[:, :, 2] = -normalised / z[:, None]
    by_point = focal[:, None] * (distortion_jacobian(intrinsics, normalised) @ to_normalised)
    by_pose = np.concatenate([-by_point @ _cross_matrix(turned), by_point], axis=2)
    pixels = distort(intrinsics, normalised) * focal + [intrinsics.cx, intrinsics.cy]
    return pixels, by_pose, pixel_jacobian(intrinsics, normalised)


def ray_derivatives(intrinsics: Intrinsics, pose: Pose, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return rays (n, 3) through points, and the change of ray and pin-hole (n, 3, parameters).

    The rays are not of unit length, and the pixels are held.
    """
    inside = transform(pose, points)
    normalised = inside[:, :2] / inside[:, 2:]
    lifted = np.concatenate([normalised, np.ones((len(points), 1))], axis=1)
    focal = np.array([intrinsics.fx, intrinsics.fy])
    by_normalised = focal[:, None] * distortion_jacobian(intrinsics, normalised)
    back = pose.matrix().T
    by_ray, by_hole = np.zeros((2, len(points), 3, PER_SENSOR))
    by_ray[:, :, :3] = back @ _cross_matrix(lifted)  # R^T exp(-[r]x) d = R^T (d + d x r)
    by_ray[:, :, PER_POSE:] = back[:, :2] @ -np.linalg.solve(
        by_normalised, pixel_jacobian(intrinsics, normalised)
    )
    shift = np.array(pose.translation)[None]
    by_hole[:, :, :3] = -back @ _cross_matrix(shift)
    by_hole[:, :, 3:PER_POSE] = -back
    return lifted @ back.T, by_ray, by_hole


def gap_derivatives(
    camera: tuple[Intrinsics, Pose], projector: tuple[Intrinsics, Pose], points: Floats
) -> Floats:
    """Return how the signed ray gap changes with the parameters of a pair whose rays meet.

    Parameters
    ----------
    camera, projector
        The pair.
    points
        (n, 3) in mm, where the rays meet; both pixels are held.

    Returns
    -------
    (n, parameters) in mm per unit of each, the camera's first.

    Notes
    -----
    With n = u x v of the rays and b the way between the pin-holes, the gap is b n / |n| (thesis Eq. (1.26)).
    Where the rays meet, b lies in their plane, and
    d(gap) = (db n + b (du x v) + b (u x dv)) / |n|.
    """
    points = np.asarray(points, dtype=np.float64)
    u, by_u, by_hole = ray_derivatives(*camera, points)
    v, by_v, by_other = ray_derivatives(*projector, points)
    base = projector[1].centre() - camera[1].centre()
    normal = np.cross(u, v)
    rows = np.concatenate(
        [
            np.einsum("ni,nij->nj", np.cross(v, base), by_u) - np.einsum("ni,nij->nj", normal, by_hole),
            np.einsum("ni,nij->nj", np.cross(base, u), by_v) + np.einsum("ni,nij->nj", normal, by_other),
        ],
        axis=1,
    )
    return np.asarray(rows / np.linalg.norm(normal, axis=1, keepdims=True))
