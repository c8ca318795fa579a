"""The camera model of `metrology.geometry` for one ray at a time, to be called from kernels.

It is written out here a second time: what the virtual rig renders is a witness of the metrology only as long
as the two share no equation.

A sensor travels as one array: fx, fy, cx, cy, k1, k2, p1, p2, k3 (0 - 8), rotation by rows (9 - 17),
translation (18 - 20), pin-hole (21 - 23), columns (24) and rows (25).
"""

from __future__ import annotations

from math import sqrt
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel
from sms_jobs.records.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]


def packed_sensor(sensor: Sensor) -> Floats:
    """Return a sensor as the array that the kernels take, (26,)."""
    i = sensor.intrinsics
    return np.concatenate(
        [
            [i.fx, i.fy, i.cx, i.cy, i.k1, i.k2, i.p1, i.p2, i.k3],
            sensor.pose.matrix().ravel(),
            sensor.pose.translation,
            sensor.pose.centre(),
            [sensor.columns, sensor.rows],
        ]
    ).astype(np.float64)


@kernel
def pixel_ray(
    sensor: Floats, px: float, py: float, x: float, y: float
) -> tuple[float, float, float, float, float]:
    """Return the unit direction in the world of a pixel's ray, and its normalised image point.

    Newton's method on the distortion starts from the normalised point (x, y); see `lens.undistort`.
    """
    wx = (px - sensor[2]) / sensor[0]
    wy = (py - sensor[3]) / sensor[1]
    k1, k2, p1, p2, k3 = sensor[4], sensor[5], sensor[6], sensor[7], sensor[8]
    for _ in range(20):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        fx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - wx
        fy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - wy
        cross = x * y * slope + 2.0 * (p1 * x + p2 * y)
        a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        determinant = a * d - cross * cross
        x -= (d * fx - cross * fy) / determinant
        y -= (a * fy - cross * fx) / determinant
        # Newton squares the residual: below 1e-8 the step just made has left it at rounding level.
        if abs(fx) + abs(fy) < 1e-8:
            break
    length = sqrt(x * x + y * y + 1.0)
    ux, uy, uz = x / length, y / length, 1.0 / length
    return (
        sensor[9] * ux + sensor[12] * uy + sensor[15] * uz,
        sensor[10] * ux + sensor[13] * uy + sensor[16] * uz,
        sensor[11] * ux + sensor[14] * uy + sensor[17] * uz,
        x,
        y,
    )


@kernel
def image_point(sensor: Floats, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the pixel coordinates of a point of the world; NaN behind the sensor. See `camera.project`."""
    depth = sensor[15] * x + sensor[16] * y + sensor[17] * z + sensor[20]
    if not depth > 0.0:
        return np.nan, np.nan
    u = (sensor[9] * x + sensor[10] * y + sensor[11] * z + sensor[18]) / depth
    v = (sensor[12] * x + sensor[13] * y + sensor[14] * z + sensor[19]) / depth
    k1, k2, p1, p2, k3 = sensor[4], sensor[5], sensor[6], sensor[7], sensor[8]
    r2 = u * u + v * v
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        sensor[0] * (u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)) + sensor[2],
        sensor[1] * (v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v) + sensor[3],
    )


@kernel
def in_image(sensor: Floats, x: float, y: float) -> bool:
    """Tell whether pixel coordinates lie on the sensor, whose edge pixels reach half a pixel out."""
    return bool(-0.5 <= x <= sensor[24] - 0.5 and -0.5 <= y <= sensor[25] - 0.5)
