"""The direct linear transform: a pin-hole camera from points in space and their images."""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.starting.homography import flatness, normalising
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics

_FEWEST = 6
_PLANE = 1e-2  # spread off the plane over the largest, below which focal length and distance trade


def direct_linear_transform(
    points: Floats, pixels: Floats, sigma_px: Floats | None = None
) -> tuple[Intrinsics, Pose]:
    """Find inner parameters and pose of a sensor without distortion.

    Parameters
    ----------
    points
        (n, 3) in mm, in one frame; not on a plane.
    pixels
        (n, 2), their images.
    sigma_px
        (n,) standard deviations of the images in each direction; equal by default.

    Returns
    -------
    Intrinsics with fx, fy, cx, cy, the skew left out, and the pose that maps the points' frame to the sensor.

    Raises
    ------
    InvalidInput
        For arrays that do not fit each other.
    CalibrationFailed
        For fewer than 6 points, points on a plane, or points of which some would be behind the sensor.

    Notes
    -----
    Abdel-Aziz & Karara 1971 (thesis ref. 83), with the normalisation of Hartley 1997: the (3, 4) matrix
    P ~ K [R | T] is the singular vector of the least singular value, split by an RQ decomposition.
    """
    points, pixels = np.asarray(points, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    weight = np.ones(len(points)) if sigma_px is None else 1.0 / np.asarray(sigma_px, dtype=np.float64)
    if points.shape != (len(points), 3) or pixels.shape != (len(points), 2) or len(weight) != len(points):
        raise InvalidInput(f"points {points.shape} and pixels {pixels.shape}: give (n, 3) and (n, 2)")
    if len(points) < _FEWEST:
        raise CalibrationFailed(f"{len(points)} points are too few for a DLT, which needs {_FEWEST}")
    if flatness(points) < _PLANE:
        raise CalibrationFailed(
            f"the points are on a plane within {flatness(points):.1e} of their extent, where a DLT needs "
            f"{_PLANE:g}: add a pose of the board at another distance or tilt"
        )
    to_space, to_image = normalising(points), normalising(pixels)
    lifted = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ to_space.T
    target = pixels @ to_image[:2, :2].T + to_image[:2, 2]
    zero = np.zeros_like(lifted)
    first = np.concatenate([lifted, zero, -target[:, :1] * lifted], axis=1)
    second = np.concatenate([zero, lifted, -target[:, 1:] * lifted], axis=1)
    rows = np.concatenate([first, second])
    depth = np.ones(len(points))
    for _ in range(3):  # reweighted, so that the residuals are those of the image
        _, _, v = np.linalg.svd(rows * np.tile(weight / depth, 2)[:, None], full_matrices=False)
        p = v[-1].reshape(3, 4)
        depth = lifted @ p[2]
        if depth.mean() < 0.0:
            p, depth = -p, -depth
        if depth.min() <= 0.0:
            raise CalibrationFailed(
                f"{int((depth <= 0.0).sum())} of {len(points)} points would be behind the sensor: "
                "points and images do not belong together"
            )
    return _split(np.linalg.inv(to_image) @ p @ to_space)


def _split(matrix: Floats) -> tuple[Intrinsics, Pose]:
    """Split K [R | T], known up to a positive factor, into its parts."""
    k, rotation = rq(matrix[:, :3])
    sign = np.diag(np.sign(np.diag(k)))
    k, rotation = k @ sign, sign @ rotation
    if np.linalg.det(rotation) < 0.0:
        raise CalibrationFailed(
            "points and images are mirrored: check the directions of the board's axes and of the pixels"
        )
    translation = np.linalg.solve(k, matrix[:, 3])
    k = k / k[2, 2]
    intrinsics = Intrinsics(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    return intrinsics, Pose.from_arrays(rotation, translation)
