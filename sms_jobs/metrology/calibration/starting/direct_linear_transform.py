"""The direct linear transform: a pin-hole camera from points in space and their images."""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.starting.homography import flatness, normalising
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.projection_matrix import fit_projection

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
    The (3, 4) matrix P ~ K [R | T] of `fit_projection`, split by an RQ decomposition.
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
    return _split(fit_projection(points, pixels, normalising(points), normalising(pixels), weight))


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
