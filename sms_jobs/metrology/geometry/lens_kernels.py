"""The lens model compiled, and its inverse for one pixel at a time."""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.compilation import inner, kernel
from sms_jobs.metrology.geometry import lens

_NEWTON_STEPS = 12
_NEWTON_TOLERANCE = 1e-12  # in units of the focal length: a nanometre at a kilometre

# Functions that the others call, by their own names there.
for _called in (lens.is_plain, lens.plainly_distorted, lens.plainly_by_point):
    register_jitable(_called)

distorted = kernel(lens.distorted)
by_point = kernel(lens.by_point)
by_parameters = kernel(lens.by_parameters)
newton_start = kernel(lens.newton_start)
_is_plain = kernel(lens.is_plain)
_plainly_distorted = kernel(lens.plainly_distorted)
_plainly_by_point = kernel(lens.plainly_by_point)


@inner
@kernel
def _finished(lens: Floats, slopes: tuple[float, float, float, float], result: Floats) -> bool:
    """Fill in the derivatives of a point from those of its distortion; say whether it is within the fold."""
    a, b, c, d = slopes
    determinant = a * d - b * c
    result[2], result[3] = d / (determinant * lens[0]), -b / (determinant * lens[1])
    result[4], result[5] = -c / (determinant * lens[0]), a / (determinant * lens[1])
    return determinant > 0.0  # beyond a fold the picture is turned over


@inner
@kernel
def _bent_undistorted(lens: Floats, u: float, v: float, result: Floats) -> bool:
    """Do what `undistorted` does for a lens that is not plain."""
    x, y = newton_start(lens, u, v)
    for _ in range(_NEWTON_STEPS):
        bent_x, bent_y = distorted(lens, x, y)
        off_x, off_y = bent_x - u, bent_y - v
        a, b, c, d = by_point(lens, x, y)
        if abs(off_x) + abs(off_y) < _NEWTON_TOLERANCE:
            result[0], result[1] = x, y
            return _finished(lens, (a, b, c, d), result)
        determinant = a * d - b * c
        x -= (d * off_x - b * off_y) / determinant
        y -= (a * off_y - c * off_x) / determinant
    return False


@inner
@kernel
def undistorted(lens: Floats, pixel: Floats, result: Floats) -> bool:
    """Turn a pixel into result = (x, y, dx/du, dx/dv, dy/du, dy/dv), normalised; say whether it converged.

    `lens` is a `vector` of intrinsics. Newton on the distortion, whose Jacobian then gives the derivatives. A
    plain lens has a loop of its own, short enough to be compiled into what calls it.
    """
    target_x, target_y = (pixel[0] - lens[2]) / lens[0], (pixel[1] - lens[3]) / lens[1]
    if not np.isfinite(target_x + target_y):
        return False  # Newton's method would try all its steps to find that out
    if not _is_plain(lens):
        return _bent_undistorted(lens, target_x, target_y, result)
    x, y = target_x, target_y
    for _ in range(_NEWTON_STEPS):
        bent_x, bent_y = _plainly_distorted(lens, x, y)
        off_x, off_y = bent_x - target_x, bent_y - target_y
        a, b, c, d = _plainly_by_point(lens, x, y)
        if abs(off_x) + abs(off_y) < _NEWTON_TOLERANCE:
            result[0], result[1] = x, y
            return _finished(lens, (a, b, c, d), result)
        determinant = a * d - b * c
        x -= (d * off_x - b * off_y) / determinant
        y -= (a * off_y - c * off_x) / determinant
    return False


@inner
@kernel
def _undistort_singly(lens: Floats, pixels: Floats, which: Ints, result: Floats) -> None:
    """Do the work of `undistort_some` of a lens that is not plain, or beside its fold."""
    pixel, one = np.empty(2), np.empty(6)
    for k in range(len(which)):
        pixel[0], pixel[1] = pixels[0, which[k]], pixels[1, which[k]]
        found = undistorted(lens, pixel, one)
        for i in range(6):
            result[i, k] = one[i] if found else np.nan


@inner
@kernel
def undistort_some(lens: Floats, pixels: Floats, which: Ints, result: Floats) -> None:
    """Do for some of the pixels (2, n) what `undistorted` does for one; result (6, len(which)), NaN for none.

    Of a plain lens each step is a loop over them, in which several are done at a time: a quarter of the time.
    """
    count, steps = len(which), 0
    target = np.empty((2, count))
    u, v, x, y = target[0], target[1], result[0], result[1]
    for k in range(count):
        u[k] = (pixels[0, which[k]] - lens[2]) / lens[0]
        v[k] = (pixels[1, which[k]] - lens[3]) / lens[1]
        x[k], y[k] = u[k], v[k]
    on_their_way = count
    while _is_plain(lens) and on_their_way > 0 and steps < _NEWTON_STEPS:
        steps, on_their_way = steps + 1, 0
        for k in range(count):
            bent_x, bent_y = _plainly_distorted(lens, x[k], y[k])
            off_x, off_y = bent_x - u[k], bent_y - v[k]
            a, b, c, d = _plainly_by_point(lens, x[k], y[k])
            determinant = a * d - b * c
            away = abs(off_x) + abs(off_y) >= _NEWTON_TOLERANCE  # of NaN it is false
            x[k] = x[k] - (d * off_x - b * off_y) / determinant if away else x[k]
            y[k] = y[k] - (a * off_y - c * off_x) / determinant if away else y[k]
            on_their_way += away
    if on_their_way > 0:
        _undistort_singly(lens, pixels, which, result)
        return
    for k in range(count):
        a, b, c, d = _plainly_by_point(lens, x[k], y[k])
        determinant = a * d - b * c if a * d - b * c > 0.0 else np.nan
        result[2, k], result[3, k] = d / (determinant * lens[0]), -b / (determinant * lens[1])
        result[4, k], result[5, k] = -c / (determinant * lens[0]), a / (determinant * lens[1])
        x[k] = x[k] if determinant > 0.0 else np.nan
