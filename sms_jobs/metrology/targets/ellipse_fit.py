"""Fits blurred ellipses to the grey levels about their edges.

The model of a dot is I = G + (K - G) Phi(-d / s): G and K are planes of grey levels, of the ground and of
the ink, d is the distance from the ellipse's edge (outwards positive, to first order in d) and Phi is the
normal distribution, so that s is the blur of lens and pixel together. The ellipse is |M (x - c)| = 1 with a
symmetric 2 x 2 matrix M. All twelve parameters are found by least squares over the pixels near the edge.
Model and first-order distance are symmetric about the centre, hence the centre is free of their errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel
from sms_jobs.metrology.small_systems import back_substitute, factorise

FITTED = 0
TOO_FEW_PIXELS = 1
AT_THE_BORDER = 2
RAN_AWAY = 3
NOT_CONVERGED = 4

_PARAMETERS = 12
_OUTPUTS = 12
_SQRT_2 = math.sqrt(2.0)
_SQRT_2_PI = math.sqrt(2.0 * math.pi)
_LEAST_BLUR_PX = 0.29  # of a pixel's box alone
_HALVED = 12  # iterations after which steps are halved: edges along pixel rows make whole ones swing
_CONVERGED_PX = 2e-4  # far below any standard deviation of a centre
_ITERATIONS = 25
_SETTLING = 6  # iterations in which the band follows the ellipse; it is held afterwards


@dataclass(frozen=True)
class FittedEllipses:
    """Ellipses fitted to an image, those that failed included.

    Attributes
    ----------
    status
        (n,), `FITTED` or why not.
    centre
        (n, 2), in px.
    matrix
        (n, 2, 2), M of |M (x - c)| = 1, in 1/px.
    covariance
        (n, 2, 2), of the centre, in px squared.
    blur
        (n,), standard deviation s of the edge's profile, in px.
    ground, ink
        (n,), grey levels at the centre, of the planes about and in the dot.
    residual
        (n,), standard deviation of grey levels from the model.
    """

    status: NDArray[np.int32]
    centre: Floats
    matrix: Floats
    covariance: Floats
    blur: Floats
    ground: Floats
    ink: Floats
    residual: Floats

    def chosen(self, which: Mask) -> FittedEllipses:
        """Return some of the ellipses."""
        return FittedEllipses(**{name: getattr(self, name)[which] for name in self.__dataclass_fields__})

    def where(self, better: Mask, others: FittedEllipses) -> FittedEllipses:
        """Return as many ellipses, the others' where they are better."""
        parts = {name: getattr(self, name).copy() for name in self.__dataclass_fields__}
        for name, part in parts.items():
            part[better] = getattr(others, name)[better]
        return FittedEllipses(**parts)


@inner
@kernel
def _near_edge(
    image: Singles, p: Floats, inner: float, outer: float
) -> tuple[int, Floats]:  # pragma: no cover - compiled
    """Return the pixels (x, y, grey level, distance) near the edge of an ellipse; -1 beyond the border."""
    rows, columns = image.shape
    determinant = p[2] * p[4] - p[3] * p[3]
    half_x = math.sqrt(p[4] ** 2 + p[3] ** 2) / determinant + outer
    half_y = math.sqrt(p[2] ** 2 + p[3] ** 2) / determinant + outer
    x0, x1 = math.ceil(p[0] - half_x), math.floor(p[0] + half_x)
    y0, y1 = math.ceil(p[1] - half_y), math.floor(p[1] + half_y)
    if x0 < 0 or y0 < 0 or x1 >= columns or y1 >= rows:
        return -1, np.empty((0, 4))
    pixels = np.empty(((x1 - x0 + 1) * (y1 - y0 + 1), 4))
    count = 0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            px, py = x - p[0], y - p[1]
            ax, ay = p[2] * px + p[3] * py, p[3] * px + p[4] * py
            q = math.sqrt(ax * ax + ay * ay)
            if q < 1e-3:
                continue
            d = (q - 1.0) * q / math.sqrt((p[2] * ax + p[3] * ay) ** 2 + (p[3] * ax + p[4] * ay) ** 2)
            if -inner <= d <= outer:
                pixels[count, 0], pixels[count, 1] = x, y
                pixels[count, 2], pixels[count, 3] = image[y, x], d
                count += 1
    return count, pixels


@inner
@uncounted_kernel
def _first_levels(pixels: Floats, count: int, p: Floats) -> bool:  # pragma: no cover - compiled
    """Set the levels of ground and ink to the means outside and inside; False where one has no pixel."""
    outside, n_outside, inside, n_inside, deepest, depth = 0.0, 0, 0.0, 0, 0.0, 0.0
    for i in range(count):
        if pixels[i, 3] > 1.0:
            outside += pixels[i, 2]
            n_outside += 1
        elif pixels[i, 3] < -1.0:
            inside += pixels[i, 2]
            n_inside += 1
        if pixels[i, 3] < depth:
            depth, deepest = pixels[i, 3], pixels[i, 2]
    if n_outside < 6 or depth == 0.0:
        return False
    p[6] = outside / n_outside
    p[9] = inside / n_inside if n_inside > 0 else deepest
    return True


@inner
@kernel
def _normal_equations(
    pixels: Floats, count: int, p: Floats, origin: Floats, normal: Floats, right: Floats
) -> float:  # pragma: no cover - compiled
    """Fill the normal equations of a Gauss-Newton step, of the matrix the lower triangle.

    Return the sum of squared residuals.
    """
    normal[:] = 0.0
    right[:] = 0.0
    total = 0.0
    j = np.empty(_PARAMETERS)
    blur = p[5]
    for i in range(count):
        x, y = pixels[i, 0], pixels[i, 1]
        px, py = x - p[0], y - p[1]
        ax, ay = p[2] * px + p[3] * py, p[3] * px + p[4] * py
        q = math.sqrt(ax * ax + ay * ay) + 1e-9
        gx, gy = (p[2] * ax + p[3] * ay) / q, (p[3] * ax + p[4] * ay) / q
        slope = math.sqrt(gx * gx + gy * gy)
        d = (q - 1.0) / slope
        u, v = (x - origin[0]) / origin[2], (y - origin[1]) / origin[2]
        phi = 0.5 * math.erfc(d / (_SQRT_2 * blur))
        bell = math.exp(-0.5 * d * d / (blur * blur)) / (_SQRT_2_PI * blur)
        step = p[9] + p[10] * u + p[11] * v - p[6] - p[7] * u - p[8] * v
        by_q = -bell * step / (slope * q)  # over q, which each derivative of q has below it
        j[0], j[1] = -by_q * gx * q, -by_q * gy * q
        j[2], j[3], j[4] = by_q * ax * px, by_q * (ax * py + ay * px), by_q * ay * py
        j[5] = bell * d / blur * step
        j[6], j[7], j[8] = 1.0 - phi, (1.0 - phi) * u, (1.0 - phi) * v
        j[9], j[10], j[11] = phi, phi * u, phi * v
        residual = pixels[i, 2] - (p[6] + p[7] * u + p[8] * v + step * phi)
        total += residual * residual
        for a in range(_PARAMETERS):
            right[a] += j[a] * residual
            for b in range(a + 1):
                normal[a, b] += j[a] * j[b]
    return total


@inner
@uncounted_kernel
def _step(
    p: Floats, size: float, variance: float, normal: Floats, right: Floats, most: float
) -> float:  # pragma: no cover - compiled
    """Take at most a part of a Gauss-Newton step; return its size in pixels, infinite where it was cut.

    The matrix is replaced by its Cholesky factor. Where there is none, no step is taken: NaN.
    """
    # Slopes across the dot of more than half the contrast are not light: hold them with that much.
    hold = variance / (0.25 * (p[9] - p[6]) ** 2 + 1e-12) + 1e-12
    for a in (7, 8, 10, 11):
        normal[a, a] += hold
        right[a] -= hold * p[a]
    for a in range(_PARAMETERS):
        normal[a, a] = normal[a, a] * (1.0 + 1e-9) + 1e-30
    if not factorise(normal):
        return np.nan
    back_substitute(normal, right)
    change = right
    moved = math.sqrt(change[0] ** 2 + change[1] ** 2)
    reshaped = max(abs(change[2]), abs(change[3]), abs(change[4])) * size
    scale = most * min(1.0, (0.2 * size + 0.5) / (moved + 1e-12), 0.2 / (reshaped + 1e-12))
    for a in range(5):
        p[a] += scale * change[a]
    p[5] = min(max(p[5] + scale * change[5], 0.7 * p[5], _LEAST_BLUR_PX), 1.5 * p[5])
    for a in range(6, _PARAMETERS):
        p[a] += change[a]
    return max(moved, reshaped) if scale == most else np.inf


@inner
@kernel
def _fit_one(image: Singles, start: Floats, out: Floats) -> int:  # pragma: no cover - compiled
    p = np.zeros(_PARAMETERS)
    for i in range(5):
        p[i] = start[i]
    p[5] = 0.8
    # The start is the origin of the planes, and the ellipse's size the unit of their slopes.
    size = 1.0 / math.sqrt(p[2] * p[4] - p[3] * p[3])
    origin = np.array([p[0], p[1], size])
    normal = np.zeros((_PARAMETERS, _PARAMETERS))
    right = np.zeros(_PARAMETERS)
    variance, count, status = 0.0, 0, NOT_CONVERGED
    pixels = np.empty((0, 4))
    for iteration in range(_ITERATIONS):
        if iteration < _SETTLING:
            band = min(max(3.0, 3.0 * p[5]), 12.0)
            count, pixels = _near_edge(image, p, min(start[5], band), min(start[6], band))
            if count < 0:
                return AT_THE_BORDER
            if count < _PARAMETERS + 4:
                return TOO_FEW_PIXELS
        if iteration == 0 and not _first_levels(pixels, count, p):
            return TOO_FEW_PIXELS
        variance = _normal_equations(pixels, count, p, origin, normal, right) / (count - _PARAMETERS)
        step = _step(p, size, variance, normal, right, 1.0 if iteration < _HALVED else 0.5)
        if np.isnan(step):
            return RAN_AWAY
        area = (p[2] * p[4] - p[3] * p[3]) * size * size
        away = math.sqrt((p[0] - origin[0]) ** 2 + (p[1] - origin[1]) ** 2)
        if not (0.25 < area < 4.0 and away < 0.5 * size + 0.5 and p[2] > 0.0):
            return RAN_AWAY
        if iteration > 1 and step < _CONVERGED_PX:
            status = FITTED
            break
    u, v = (p[0] - origin[0]) / size, (p[1] - origin[1]) / size
    for i in range(6):
        out[i] = p[i]
    out[6] = p[6] + p[7] * u + p[8] * v
    out[7] = p[9] + p[10] * u + p[11] * v
    for a in range(2):
        by_one = np.zeros(_PARAMETERS)
        by_one[a] = variance
        back_substitute(normal, by_one)
        out[8 + a], out[9 + a] = by_one[0], by_one[1]
    out[11] = math.sqrt(variance)
    return status


@kernel
def _fit_block(
    image: Singles,
    starts: Floats,
    first: int,
    last: int,
    out: Floats,
    status: NDArray[np.int32],
) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        status[i] = _fit_one(image, starts[i], out[i])


def fit_ellipses(
    image: Singles,
    centre: Floats,
    matrix: Floats,
    inner: Floats,
    outer: Floats,
    *,
    threads: int = 1,
) -> FittedEllipses:
    """Fit blurred ellipses to an image from starts that are right to about a pixel.

    Parameters
    ----------
    image
        (rows, columns), grey levels.
    centre
        (n, 2), in px.
    matrix
        (n, 2, 2), symmetric M of |M (x - c)| = 1, in 1/px.
    inner, outer
        (n,), how far from the edge, in px, grey levels may be taken inside and outside; beyond three times
        the blur none are taken anyway.
    threads
        Number of threads; never changes a result.

    Returns
    -------
    One ellipse a start. The covariance is that of independent noise with the residuals' variance.
    """
    n = len(centre)
    starts = np.empty((n, 7))
    starts[:, :2] = centre
    starts[:, 2], starts[:, 3], starts[:, 4] = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    starts[:, 5], starts[:, 6] = inner, outer
    out = np.full((n, _OUTPUTS), np.nan)
    status = np.full(n, NOT_CONVERGED, dtype=np.int32)
    grey = np.ascontiguousarray(image, dtype=np.float32)

    def work(first: int, last: int) -> None:
        _fit_block(grey, starts, first, last, out, status)

    in_row_blocks(work, n, threads, block=32)
    return FittedEllipses(
        status=status,
        centre=out[:, :2],
        matrix=out[:, [2, 3, 3, 4]].reshape(n, 2, 2),
        covariance=out[:, [8, 9, 9, 10]].reshape(n, 2, 2),
        blur=out[:, 5],
        ground=out[:, 6],
        ink=out[:, 7],
        residual=out[:, 11],
    )
