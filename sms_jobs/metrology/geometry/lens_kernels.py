"""The lens model compiled, and its inverse for one pixel at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.geometry import lens

Floats = NDArray[np.float64]

_NEWTON_STEPS = 12
_NEWTON_TOLERANCE = 1e-12  # in units of the focal length: a nanometre at a kilometre

distorted = kernel(lens.distorted)
by_point = kernel(lens.by_point)
by_parameters = kernel(lens.by_parameters)


@kernel
def undistorted(lens: Floats, pixel: Floats, result: Floats) -> bool:
    """Turn a pixel into result = (x, y, dx/du, dx/dv, dy/du, dy/dv), normalised; say whether it converged.

    `lens` is a `vector` of intrinsics. Newton on the distortion, whose Jacobian then gives the derivatives.
    """
    fx, fy = lens[0], lens[1]
    target_x, target_y = (pixel[0] - lens[2]) / fx, (pixel[1] - lens[3]) / fy
    x, y = target_x, target_y
    for _ in range(_NEWTON_STEPS):
        bent_x, bent_y = distorted(lens, x, y)
        off_x, off_y = bent_x - target_x, bent_y - target_y
        a, b, c, d = by_point(lens, x, y)
        determinant = a * d - b * c
        if abs(off_x) + abs(off_y) < _NEWTON_TOLERANCE:
            result[0], result[1] = x, y
            result[2], result[3] = d / (determinant * fx), -b / (determinant * fy)
            result[4], result[5] = -c / (determinant * fx), a / (determinant * fy)
            return True
        x -= (d * off_x - b * off_y) / determinant
        y -= (a * off_y - c * off_x) / determinant
    return False
