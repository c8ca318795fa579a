"""The camera model of `metrology.geometry` for one ray at a time, to be called from kernels.

It is written out here a second time: what the virtual rig renders is a witness of the metrology only as long
as the two share no equation.

A sensor travels as one array: fx, fy, cx, cy (0 - 3), rotation by rows (4 - 12), translation (13 - 15),
pin-hole (16 - 18), columns (19), rows (20), the distortion's k1, k2, p1, p2, k3 (21 - 25), the skew in
units of fx (26), k4, k5, k6 (27 - 29), and 1 for a fisheye (30).
"""

from __future__ import annotations

from math import atan2, cos, pi, sin, sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel
from sms_jobs.records.sensors import Sensor


def packed_sensor(sensor: Sensor) -> Floats:
    """Return a sensor as the array that the kernels take, (31,)."""
    i = sensor.intrinsics
    return np.concatenate(
        [
            [i.fx, i.fy, i.cx, i.cy],
            sensor.pose.matrix().ravel(),
            sensor.pose.translation,
            sensor.pose.centre(),
            [sensor.columns, sensor.rows],
            [i.k1, i.k2, i.p1, i.p2, i.k3],
            [i.skew, i.k4, i.k5, i.k6, i.fisheye],
        ]
    ).astype(np.float64)


@inner
@uncounted_kernel
def _fisheye_height(sensor: Floats, angle: float) -> tuple[float, float]:
    """Return the height of a ray's image over the axis, in focal lengths, and its derivative by the angle."""
    square, power, height, growth = angle * angle, 1.0, angle, 1.0
    for k in range(4):
        of = sensor[(21, 22, 25, 27)[k]]
        power *= square
        height += of * power * angle
        growth += (2 * k + 3) * of * power
    return height, growth


@inner
@uncounted_kernel
def _fisheye_point(sensor: Floats, wx: float, wy: float) -> tuple[float, float]:
    """Return the normalised point of a distorted one; NaN where no ray within 90 degrees has it."""
    height = sqrt(wx * wx + wy * wy)
    if height == 0.0:
        return 0.0, 0.0
    low, high = 0.0, 0.5 * pi
    if height >= _fisheye_height(sensor, high)[0]:
        return np.nan, np.nan
    angle = min(height, 0.5 * high)
    for _ in range(60):
        off, growth = _fisheye_height(sensor, angle)
        off -= height
        low, high = (low, angle) if off > 0.0 else (angle, high)
        step = angle - off / growth
        angle = step if low <= step <= high else 0.5 * (low + high)
        if abs(off) < 1e-15:
            break
    r = sin(angle) / cos(angle)
    return r * wx / height, r * wy / height


@inner
@uncounted_kernel
def pixel_ray(
    sensor: Floats, px: float, py: float, x: float, y: float
) -> tuple[float, float, float, float, float]:
    """Return the unit direction in the world of a pixel's ray, and its normalised image point.

    Newton's method on the distortion starts from the normalised point (x, y); see `lens.undistort`.
    """
    wy = (py - sensor[3]) / sensor[1]
    wx = (px - sensor[2]) / sensor[0] - sensor[26] * wy
    k1, k2, p1, p2, k3 = sensor[21], sensor[22], sensor[23], sensor[24], sensor[25]
    k4, k5, k6 = sensor[27], sensor[28], sensor[29]
    if sensor[30] != 0.0:
        x, y = _fisheye_point(sensor, wx, wy)
    for _ in range(0 if sensor[30] != 0.0 else 20):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        if k4 != 0.0 or k5 != 0.0 or k6 != 0.0:
            over = 1.0 / (1.0 + k4 * r2 + k5 * r2 * r2 + k6 * r2 * r2 * r2)
            slope = over * slope - 2.0 * over * over * radial * (k4 + 2.0 * k5 * r2 + 3.0 * k6 * r2 * r2)
            radial *= over
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
        sensor[4] * ux + sensor[7] * uy + sensor[10] * uz,
        sensor[5] * ux + sensor[8] * uy + sensor[11] * uz,
        sensor[6] * ux + sensor[9] * uy + sensor[12] * uz,
        x,
        y,
    )


@uncounted_kernel
def image_point(sensor: Floats, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the pixel coordinates of a point of the world; NaN behind the sensor. See `camera.project`."""
    depth = sensor[10] * x + sensor[11] * y + sensor[12] * z + sensor[15]
    if not depth > 0.0:
        return np.nan, np.nan
    u = (sensor[4] * x + sensor[5] * y + sensor[6] * z + sensor[13]) / depth
    v = (sensor[7] * x + sensor[8] * y + sensor[9] * z + sensor[14]) / depth
    k1, k2, p1, p2, k3 = sensor[21], sensor[22], sensor[23], sensor[24], sensor[25]
    r2 = u * u + v * v
    if sensor[30] != 0.0:
        r = sqrt(r2)
        radial = _fisheye_height(sensor, atan2(r, 1.0))[0] / r if r > 0.0 else 1.0
    else:
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial /= 1.0 + sensor[27] * r2 + sensor[28] * r2 * r2 + sensor[29] * r2 * r2 * r2
    wx = u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    wy = v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
    return sensor[0] * (wx + sensor[26] * wy) + sensor[2], sensor[1] * wy + sensor[3]


@inner
@uncounted_kernel
def in_image(sensor: Floats, x: float, y: float) -> bool:
    """Tell whether pixel coordinates lie on the sensor, whose edge pixels reach half a pixel out."""
    return bool(-0.5 <= x <= sensor[19] - 0.5 and -0.5 <= y <= sensor[20] - 0.5)
