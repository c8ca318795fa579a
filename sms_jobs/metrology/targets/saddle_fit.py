"""Fits blurred corners of a chessboard to grey levels.

The model is I = g + g_u u + g_v v + c erf(l_1 / (sqrt 2 s)) erf(l_2 / (sqrt 2 s)): l_1 and l_2 are distances
from two lines that cross in the corner, s is the blur of lens and pixel together. Nine parameters are found
by least squares over a disc about the corner. The model looks the same from both sides of the corner, so
errors of blur and contrast do not move it.
"""

from __future__ import annotations

import math

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel
from sms_jobs.metrology.small_systems import back_substitute, factorise

_PARAMETERS = 9
_ITERATIONS = 30
_SETTLING = 5  # iterations in which the disc follows the corner; it is held afterwards
_CONVERGED_PX = 2e-4
_LEAST_BLUR_PX = 0.29  # of a pixel's box alone
_HALVED = 12  # iterations after which steps are halved: edges along pixel rows make whole ones swing
_SQRT_2 = math.sqrt(2.0)
_SLOPE = math.sqrt(2.0 / math.pi)


@inner
@kernel
def _normal_equations(
    image: Singles, p: Floats, middle: Floats, radius: float, normal: Floats, right: Floats
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Fill the normal equations of a Gauss-Newton step, of the matrix the lower triangle.

    Return the sum of squares and the pixels used.
    """
    rows, columns = image.shape
    normal[:] = 0.0
    right[:] = 0.0
    total, count = 0.0, 0
    j = np.empty(_PARAMETERS)
    s = p[4]
    c1, s1, c2, s2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    reach = math.floor(radius) + 1
    for y in range(max(0, int(middle[1]) - reach), min(rows, int(middle[1]) + reach + 2)):
        for x in range(max(0, int(middle[0]) - reach), min(columns, int(middle[0]) + reach + 2)):
            if (x - middle[0]) ** 2 + (y - middle[1]) ** 2 > radius * radius:
                continue
            px, py = x - p[0], y - p[1]
            l1, l2 = -s1 * px + c1 * py, s2 * px - c2 * py
            e1, e2 = math.erf(l1 / (_SQRT_2 * s)), math.erf(l2 / (_SQRT_2 * s))
            d1 = _SLOPE / s * math.exp(-0.5 * l1 * l1 / (s * s)) * e2 * p[5]
            d2 = _SLOPE / s * math.exp(-0.5 * l2 * l2 / (s * s)) * e1 * p[5]
            u, v = (x - middle[0]) / radius, (y - middle[1]) / radius
            j[0], j[1] = d1 * s1 - d2 * s2, -d1 * c1 + d2 * c2
            j[2], j[3] = d1 * (-c1 * px - s1 * py), d2 * (c2 * px + s2 * py)
            j[4] = -(d1 * l1 + d2 * l2) / s
            j[5], j[6], j[7], j[8] = e1 * e2, 1.0, u, v
            residual = image[y, x] - (p[5] * e1 * e2 + p[6] + p[7] * u + p[8] * v)
            total += residual * residual
            count += 1
            for a in range(_PARAMETERS):
                right[a] += j[a] * residual
                for b in range(a + 1):
                    normal[a, b] += j[a] * j[b]
    for a in range(_PARAMETERS):
        normal[a, a] = normal[a, a] * (1.0 + 1e-9) + 1e-30
    return total, count


@inner
@kernel
def _fit_one(image: Singles, start: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    p = np.zeros(_PARAMETERS)
    p[0], p[1], p[2], p[3], radius = start[0], start[1], start[2], start[3], start[4]
    p[4] = 1.0
    middle = p[:2].copy()
    normal = np.zeros((_PARAMETERS, _PARAMETERS))
    right = np.zeros(_PARAMETERS)
    for iteration in range(_ITERATIONS):
        if iteration < _SETTLING:
            middle[0], middle[1] = p[0], p[1]
        total, count = _normal_equations(image, p, middle, radius, normal, right)
        if count < 3 * _PARAMETERS:
            return
        # Grey levels alone move at first: without contrast the corner has no place.
        if not factorise(normal):
            return
        back_substitute(normal, right)
        change = right
        moved = math.sqrt(change[0] ** 2 + change[1] ** 2)
        turned = radius * max(abs(change[2]), abs(change[3]))
        scale = min(1.0, 1.0 / (moved + 1e-12), 2.0 / (turned + 1e-12))
        if iteration > _HALVED:
            scale *= 0.5
        for a in range(4):
            p[a] += scale * change[a]
        p[4] = min(max(p[4] + scale * change[4], 0.7 * p[4], _LEAST_BLUR_PX), 1.5 * p[4])
        for a in range(5, _PARAMETERS):
            p[a] += change[a]
        if not math.hypot(p[0] - start[0], p[1] - start[1]) < 0.5 * radius:
            return
        if iteration > _SETTLING and moved < _CONVERGED_PX:
            variance = total / (count - _PARAMETERS)
            out[0], out[1], out[5], out[6] = p[0], p[1], p[5], math.sqrt(variance)
            for a in range(2):
                by_one = np.zeros(_PARAMETERS)
                by_one[a] = variance
                back_substitute(normal, by_one)
                out[2 + a], out[3 + a] = by_one[0], by_one[1]
            return


@kernel
def _fit_block(
    image: Singles, starts: Floats, first: int, last: int, out: Floats
) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        _fit_one(image, starts[i], out[i])


def fit_saddles(
    image: Singles,
    corner: Floats,
    first_angle: Floats,
    second_angle: Floats,
    radius: Floats,
    *,
    threads: int = 1,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit blurred corners to an image from starts that are right to a pixel or two.

    Parameters
    ----------
    image
        (rows, columns), grey levels.
    corner
        (n, 2), in px.
    first_angle, second_angle
        (n,), in rad from x to y, of the two lines; the second is at most half a turn after the first.
    radius
        (n,), of the disc whose pixels are used, in px.
    threads
        Number of threads; never changes a result.

    Returns
    -------
    Corners (n, 2) in px, their covariances (n, 2, 2) in px squared, the contrasts c (n,), positive where it
    is bright between the first line and the second, and the residuals' standard deviation (n,). NaN where
    there is no corner. The covariance is that of independent noise with the residuals' variance.
    """
    starts = np.column_stack([corner, first_angle, second_angle, radius])
    out = np.full((len(starts), 7), np.nan)
    grey = np.ascontiguousarray(image, dtype=np.float32)

    def work(first: int, last: int) -> None:
        _fit_block(grey, starts, first, last, out)

    in_row_blocks(work, len(starts), threads, block=32)
    return out[:, :2], out[:, [2, 3, 3, 4]].reshape(-1, 2, 2), out[:, 5], out[:, 6]
