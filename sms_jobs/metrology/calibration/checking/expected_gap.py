"""By how much the rays of a pair may miss each other because its calibration is not exact."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.pair_points import Parameters
from sms_jobs.metrology.calibration.sensor_derivatives import gap_derivatives


def pixel_size(sensor: Parameters, points: Floats) -> Floats:
    """Return the width in mm, (...), that a pixel of a sensor has at points (..., 3) in mm.

    It is the distance along the optical axis over the focal length.
    """
    intrinsics, pose = sensor
    depth = points @ pose.matrix()[2] + pose.translation[2]
    return np.asarray(depth / np.sqrt(intrinsics.fx * intrinsics.fy))


def expected_gap_px(camera: Parameters, projector: Parameters, covariance: Floats, points: Floats) -> float:
    """Return the standard deviation of the ray gap from the calibration, in pixels of the projector.

    Parameters
    ----------
    camera, projector
        The pair.
    covariance
        Of the parameters of both, the camera's first, in rad, mm and px.
    points
        (n, 3) in mm: where; the root mean square over those that lie before both sensors is taken.

    Notes
    -----
    J C J^T with the derivatives of the gap, over the width of a pixel there.
    """
    derivatives = gap_derivatives(camera, projector, points)
    variance = np.einsum("ni,ij,nj->n", derivatives, covariance, derivatives)
    size = pixel_size(projector, points)
    before = np.isfinite(variance) & (size > 0.0)
    return float(np.sqrt(np.mean(variance[before] / np.square(size[before])))) if before.any() else 0.0
