"""Rays of a bundle adjustment, and what changes with their directions."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, kernel, uncounted_kernel
from sms_jobs.metrology.geometry.camera import PER_POSE
from sms_jobs.metrology.geometry.lens import PER_LENS, PIN_HOLE
from sms_jobs.metrology.geometry.lens_kernels import by_parameters, undistorted


@inner
@uncounted_kernel
def cross(a: Floats, b: Floats, result: Floats) -> None:
    """Fill result (3,) with the cross product."""
    result[0] = a[1] * b[2] - a[2] * b[1]
    result[1] = a[2] * b[0] - a[0] * b[2]
    result[2] = a[0] * b[1] - a[1] * b[0]


@inner
@uncounted_kernel
def dot(a: Floats, b: Floats) -> float:
    """Return the scalar product of two vectors of space."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@inner
@uncounted_kernel
def pin_hole(rotation: Floats, translation: Floats, result: Floats) -> None:
    """Fill result (3,) with -R^T T, in mm."""
    for i in range(3):
        result[i] = -dot(rotation[:, i], translation)


@inner
@uncounted_kernel
def ray(rotation: Floats, lens: Floats, pixel: Floats, inner: Floats, turn: Floats, v: Floats) -> bool:
    """Follow a pixel's ray: its direction and how it changes with the lens; say whether the lens has one.

    Fills `inner` (6,) as `undistorted` does; `turn` (2, parameters of the lens) with the derivatives of the
    normalised point, by the implicit function theorem on the distortion; and v (3,) with the direction in
    the world, R^T (x, y, 1).
    """
    if not undistorted(lens, pixel, inner):
        return False
    x, y = inner[0], inner[1]
    u, w = (pixel[0] - lens[2]) / lens[0], (pixel[1] - lens[3]) / lens[1]
    by_parameters(lens, x, y, turn[:, PIN_HOLE:])
    a, b, c, d = inner[2] * lens[0], inner[3] * lens[1], inner[4] * lens[0], inner[5] * lens[1]
    for k in range(PIN_HOLE, PER_LENS):
        off_x, off_y = turn[0, k], turn[1, k]
        turn[0, k], turn[1, k] = -(a * off_x + b * off_y), -(c * off_x + d * off_y)
    for i in range(2):
        du, dv = inner[2 + 2 * i], inner[3 + 2 * i]
        turn[i, 0], turn[i, 1], turn[i, 2], turn[i, 3] = -u * du, -w * dv, -du, -dv
    for i in range(3):
        v[i] = rotation[0, i] * x + rotation[1, i] * y + rotation[2, i]
    return True


@inner
@uncounted_kernel
def to_sensor(
    rotation: Floats, translation: Floats, inner: Floats, turn: Floats, by: Floats, row: Floats
) -> None:
    """Turn the derivatives of a residual by a ray into those by the sensor's parameters.

    `by` (2, 3) holds the derivatives by the pin-hole and by the direction, in the world. With
    R <- exp([r]x) R the pin-hole -R^T T moves by R^T (r x T - dT), and the direction R^T d by R^T (d x r).
    """
    cx, cy, cz, vx, vy, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        cx += rotation[0, j] * by[0, j]
        cy += rotation[1, j] * by[0, j]
        cz += rotation[2, j] * by[0, j]
        vx += rotation[0, j] * by[1, j]
        vy += rotation[1, j] * by[1, j]
        vz += rotation[2, j] * by[1, j]
    x, y = inner[0], inner[1]
    row[0] = translation[1] * cz - translation[2] * cy + vy - vz * y
    row[1] = translation[2] * cx - translation[0] * cz + vz * x - vx
    row[2] = translation[0] * cy - translation[1] * cx + vx * y - vy * x
    row[3], row[4], row[5] = -cx, -cy, -cz
    for k in range(PER_LENS):
        row[PER_POSE + k] = vx * turn[0, k] + vy * turn[1, k]


@inner
@kernel
def gap_change(u: Floats, v: Floats, base: Floats, by: Floats) -> float:
    """Return the signed gap of two rays, and fill `by` (3, 3) with its derivatives by base, u and v.

    The gap is epsilon_1 = b n / |n| with n = u x v and b from the first pin-hole to the second (thesis
    Eq. (1.26)); with q = (b - gap n / |n|) / |n| it changes by q dn + n db / |n|.
    """
    n, q = np.empty(3), np.empty(3)
    cross(u, v, n)
    length = np.sqrt(dot(n, n))
    gap = dot(base, n) / length
    for i in range(3):
        by[0, i] = n[i] / length
        q[i] = (base[i] - gap * by[0, i]) / length
    cross(v, q, by[1])
    cross(q, u, by[2])
    return float(gap)


@inner
@kernel
def along_change(u: Floats, v: Floats, base: Floats, by: Floats) -> float:
    """Return s of the first ray's point s u that is nearest the second, and its derivatives as `gap_change`.

    s = (b x v) n / n^2 with n = u x v; NaN where the rays approach behind one of the pin-holes.
    """
    n, m, h, k = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    cross(u, v, n)
    square = dot(n, n)
    cross(base, v, m)
    s = dot(m, n) / square
    cross(base, u, k)
    if not (s > 0.0 and dot(k, n) > 0.0):
        return np.nan
    for i in range(3):
        h[i] = (m[i] - 2.0 * s * n[i]) / square
    cross(v, n, by[0])
    cross(v, h, by[1])
    cross(n, base, by[2])
    cross(h, u, k)
    for i in range(3):
        by[0, i] /= square
        by[2, i] = by[2, i] / square + k[i]
    return s
