"""Focal length, principal point and board poses in closed form, from homographies of a board."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics


def _constraint(h: Floats, i: int, j: int) -> Floats:
    """Return v with v (b11, b22, b13, b23, b33) = h_i^T B h_j for zero skew, Zhang 2000, below Eq. (7)."""
    a, b = h[:, i], h[:, j]
    mixed_x, mixed_y = a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1]
    return np.array([a[0] * b[0], a[1] * b[1], mixed_x, mixed_y, a[2] * b[2]])


def intrinsics_from_homographies(
    homographies: Sequence[Floats],
    centre: tuple[float, float],
    *,
    square_pixels: bool = True,
    known_principal_point: bool = True,
) -> Intrinsics:
    """Find the inner parameters of a sensor without distortion and skew from views of a board.

    Parameters
    ----------
    homographies
        (3, 3) each, from the board in mm to the image in px.
    centre
        Middle of the image (x, y), in px.
    square_pixels
        Take fx = fy.
    known_principal_point
        Take it at the middle of the image. Needed for one view.

    Raises
    ------
    CalibrationFailed
        When there are too few views for what is asked, or no real focal length fits: the board is parallel
        to the image in every view, or its poses are parallel to each other.

    Notes
    -----
    Zhang 2000, Eq. (3), (4) and (9), with B = K^-T K^-1 ~ [[b11, 0, b13], [0, b22, b23], [b13, b23, b33]],
    from the middle of the image and in units of its size.
    """
    unknown = (1 if square_pixels else 2) + (0 if known_principal_point else 2)
    if 2 * len(homographies) < unknown:
        raise CalibrationFailed(
            f"{len(homographies)} view(s) give {2 * len(homographies)} equations for {unknown} inner "
            "parameters: show the board in another tilt, or take the principal point in the middle"
        )
    size = max(centre)
    to_unit = np.array(
        [[1.0 / size, 0.0, -centre[0] / size], [0.0, 1.0 / size, -centre[1] / size], [0, 0, 1]]
    )
    rows = []
    for homography in homographies:
        h = to_unit @ homography
        # One scale for both columns keeps h1 and h2 comparable, and views at any distance weigh the same.
        h = h / np.sqrt(0.5 * np.sum(h[:, :2] ** 2))
        rows += [_constraint(h, 0, 1), _constraint(h, 0, 0) - _constraint(h, 1, 1)]
    b = _least_singular(np.array(rows), square_pixels, known_principal_point)
    x, y = -b[2] / b[0], -b[3] / b[1]
    rest = b[4] - b[2] ** 2 / b[0] - b[3] ** 2 / b[1]
    with np.errstate(invalid="ignore"):
        focal = np.sqrt(rest / b[:2])
    if not (np.isfinite(focal).all() and np.isfinite([x, y]).all() and focal.min() > 0.0):
        raise CalibrationFailed(
            "no real focal length fits the views of the board: tilt it by 20 to 45 degrees about both axes"
        )
    fx, fy = (float(f) * size for f in focal)
    return Intrinsics(fx, fy, float(x) * size + centre[0], float(y) * size + centre[1])


def _least_singular(equations: Floats, square_pixels: bool, known_principal_point: bool) -> Floats:
    """Solve equations (m, 5) for (b11, b22, b13, b23, b33), up to a factor, with what is known beforehand."""
    basis = np.eye(5)
    if square_pixels:
        basis = np.column_stack([basis[:, 0] + basis[:, 1], basis[:, 2:]])
    if known_principal_point:
        basis = np.delete(basis, [-3, -2], axis=1)
    _, _, v = np.linalg.svd(equations @ basis)
    b = basis @ v[-1]
    return np.asarray(b if b[0] > 0.0 else -b)


def pose_from_homography(homography: Floats, intrinsics: Intrinsics) -> Pose:
    """Return the pose of a board (x_sensor = R X_board + T) from its homography in px per mm.

    Zhang 2000, section 3.1: K^-1 H ~ [r1 r2 T]; the nearest rotation is taken. The board is put before the
    sensor. Distortion is left out.
    """
    a = np.linalg.solve(intrinsics.matrix(), homography)
    a = a / np.sqrt(np.linalg.norm(a[:, 0]) * np.linalg.norm(a[:, 1]))
    if a[2, 2] < 0.0:
        a = -a
    u, _, v = np.linalg.svd(np.column_stack([a[:, 0], a[:, 1], np.cross(a[:, 0], a[:, 1])]))
    return Pose.from_arrays(u @ v, a[:, 2])


def tilt(pose: Pose) -> float:
    """Return the angle in rad between a board's normal and the sensor's optical axis, 0 .. pi / 2."""
    return float(np.arccos(min(1.0, abs(pose.matrix()[2, 2]))))
