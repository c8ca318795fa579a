"""How uncertain a triangulated point is because the sensors are known only so well."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.parameters import sensor_arrays
from sms_jobs.metrology.calibration.bundle.rays import along_change, pin_hole, ray, to_sensor
from sms_jobs.metrology.calibration.bundle.result import Adjustment
from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose, project
from sms_jobs.metrology.geometry.lens import PER_LENS, Intrinsics


@kernel
def _point_rows(rotation: Floats, translation: Floats, lens: Floats, pixels: Floats, rows: Floats) -> None:
    """Fill rows (n, 3, parameters) with d(point)/d(camera's, then projector's) at pixels (n, 2, 2)."""
    inner, turn = np.empty((2, 6)), np.empty((2, 2, PER_LENS))
    direction, hole = np.empty((2, 3)), np.empty((2, 3))
    by_along, by = np.empty((3, 3)), np.empty((2, 3))
    for k in range(2):
        pin_hole(rotation[k], translation[k], hole[k])
    base = hole[1] - hole[0]
    for n in range(len(pixels)):
        seen = True
        for k in range(2):
            seen = ray(rotation[k], lens[k], pixels[n, k], inner[k], turn[k], direction[k]) and seen
        u = direction[0]
        along = along_change(u, direction[1], base, by_along) if seen else np.nan
        for i in range(3):
            for j in range(3):
                here = 1.0 if i == j else 0.0
                by[0, j] = here - u[i] * by_along[0, j]
                by[1, j] = along * here + u[i] * by_along[1, j]
            to_sensor(rotation[0], translation[0], inner[0], turn[0], by, rows[n, i, :PER_SENSOR])
            for j in range(3):
                by[0, j], by[1, j] = u[i] * by_along[0, j], u[i] * by_along[2, j]
            to_sensor(rotation[1], translation[1], inner[1], turn[1], by, rows[n, i, PER_SENSOR:])
            if not np.isfinite(along):
                rows[n, i] = np.nan


def point_jacobian(
    camera: tuple[Intrinsics, Pose], projector: tuple[Intrinsics, Pose], points: Floats
) -> Floats:
    """Return how triangulated points move with the parameters of both sensors, their pixels kept.

    Parameters
    ----------
    camera, projector
        The pair; the point is taken on the camera's ray.
    points
        (n, 3) in mm.

    Returns
    -------
    (n, 3, parameters) in mm per unit of each, the camera's first; NaN where a sensor does not see it.
    """
    pixels = np.stack([project(*sensor, points) for sensor in (camera, projector)], axis=1)
    rows = np.empty((len(points), 3, 2 * PER_SENSOR))
    rotation, translation, lens = sensor_arrays((camera, projector))
    _point_rows(rotation, translation, lens, np.ascontiguousarray(pixels), rows)
    return rows


def pair_covariance(adjustment: Adjustment, camera: str, projector: str) -> Floats:
    """Return the covariance of the parameters of a pair, the camera's first."""
    at = [adjustment.sensor(name) for name in (camera, projector)]
    index = np.concatenate([np.arange(PER_SENSOR * i, PER_SENSOR * (i + 1)) for i in at])
    return np.asarray(adjustment.covariance[np.ix_(index, index)])


def point_covariance(adjustment: Adjustment, camera: str, projector: str, points: Floats) -> Floats:
    """Return the covariance of triangulated points due to the calibration alone.

    Parameters
    ----------
    adjustment
        With the sensors' parameters and their covariance.
    camera, projector
        Names of the pair.
    points
        (n, 3) in mm, in the calibration's frame.

    Returns
    -------
    (n, 3, 3) in mm^2, J C J^T; NaN where a sensor does not see the point.
    """
    found = [adjustment.sensors[adjustment.sensor(name)] for name in (camera, projector)]
    first, second = ((s.intrinsics, s.pose) for s in found)
    rows = point_jacobian(first, second, np.asarray(points, dtype=np.float64))
    return np.asarray(rows @ pair_covariance(adjustment, camera, projector) @ rows.transpose(0, 2, 1))
