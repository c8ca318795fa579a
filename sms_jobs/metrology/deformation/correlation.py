"""Inverse-compositional Gauss-Newton matching of subsets that are cut to one region.

A subset holds the pixels of a square that lie on the same continuous region as its centre (thesis section
4.3.2), so pieces of surface that move apart are never matched as one. Matching minimises the zero-normalised
sum of squared differences, f(x) = a g(W(x)) + b, with the gain a and offset b eliminated exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import in_row_blocks, kernel, summing_kernel
from sms_jobs.metrology.images.interpolation import (
    PADDING,
    spline_coefficients,
    spline_gradient,
    spline_values,
)

Floats: TypeAlias = NDArray[np.float64]

CONVERGED, TOO_FEW_PIXELS, NO_TEXTURE, LEFT_IMAGE, NOT_CONVERGED = range(5)
"""How the matching of a point ended."""

_REACH = PADDING - 3.0  # px that a subset may run over the image's border, on the reflected spline
_WANDER = 4.0  # px from the guess beyond which an iteration has lost its subset


@dataclass(frozen=True)
class Noise:
    """Variance of an image's grey levels: `floor` + `slope` x grey level, in grey levels squared."""

    floor: float
    slope: float


@dataclass(frozen=True)
class MatchSettings:
    """How subsets are matched.

    Attributes
    ----------
    radius
        In px; a whole subset has (2 radius + 1)^2 pixels.
    minimum_part
        Smallest part of a whole subset that must lie on the region.
    tolerance
        Rms movement of a subset's pixels, in px, below which the iteration ends.
    iterations
        At most.
    """

    radius: int = 16
    minimum_part: float = 0.2
    tolerance: float = 1e-3
    iterations: int = 20


@dataclass(frozen=True)
class PreparedImages:
    """A reference and a deformed image, ready to be matched at any number of points."""

    reference: Floats
    gradient_x: Floats
    gradient_y: Floats
    coefficients: Floats
    labels: NDArray[np.int32]
    noise: tuple[Noise, Noise]


@dataclass(frozen=True)
class Matches:
    """Results at n points: see `match_points`."""

    warp: Floats
    sigma: Floats
    score: Floats
    iterations: NDArray[np.int32]
    ending: NDArray[np.int32]


def prepare_images(
    reference: NDArray[np.generic],
    deformed: NDArray[np.generic],
    labels: NDArray[np.int32],
    noise: tuple[Noise, Noise] = (Noise(0.0, 0.0), Noise(0.0, 0.0)),
) -> PreparedImages:
    """Interpolate the deformed image and differentiate the reference image.

    Parameters
    ----------
    reference, deformed
        (rows, columns), in grey levels.
    labels
        (rows, columns), continuous regions of the reference image, 0 for none.
    noise
        Of the reference and of the deformed image.
    """
    gradient_x, gradient_y = spline_gradient(spline_coefficients(reference))
    return PreparedImages(
        np.ascontiguousarray(reference, dtype=np.float64),
        gradient_x,
        gradient_y,
        spline_coefficients(deformed),
        np.ascontiguousarray(labels, dtype=np.int32),
        noise,
    )


@kernel
def _inside(warp, cx, cy, left, right, top, bottom, rows, columns, reach):  # type: ignore[no-untyped-def]
    """Return whether a box about (cx, cy) is warped into the image, or at most `reach` px over its border."""
    for x in (left, right):
        for y in (top, bottom):
            px = cx + x + warp[0] + warp[1] * x + warp[2] * y
            py = cy + y + warp[3] + warp[4] * x + warp[5] * y
            if not (px >= -reach and py >= -reach and px <= columns - 1 + reach and py <= rows - 1 + reach):
                return False
    return True


@kernel
def _collect(reference, gradient_x, gradient_y, labels, cx, cy, radius, warp, dx, dy, f, gx, gy, box):  # type: ignore[no-untyped-def]
    """Fill a subset's offsets, grey levels and slopes and their bounding box; return its number of pixels.

    A pixel belongs if it lies on the centre's region and its expected counterpart lies in the image.
    """
    rows, columns = labels.shape
    label = labels[cy, cx]
    left = max(-radius, -cx)
    right = min(radius, columns - 1 - cx)
    top = max(-radius, -cy)
    bottom = min(radius, rows - 1 - cy)
    whole = _inside(warp, cx, cy, left, right, top, bottom, rows, columns, 0.0)
    box[:] = (right, left, bottom, top)
    count = 0
    for j in range(top, bottom + 1):
        row = np.uint64(cy + j)
        first = count
        for i in range(left, right + 1):
            column = np.uint64(cx + i)
            if labels[row, column] != label:
                continue
            if not whole and not _inside(warp, cx, cy, i, i, j, j, rows, columns, 0.0):
                continue
            dx[count] = i
            dy[count] = j
            f[count] = reference[row, column]
            gx[count] = gradient_x[row, column]
            gy[count] = gradient_y[row, column]
            count += 1
        if count > first:
            box[0] = min(box[0], int(dx[first]))
            box[1] = max(box[1], int(dx[count - 1]))
            box[2] = min(box[2], j)
            box[3] = j
    return count


@summing_kernel
def _reference_sums(count, dx, dy, f, gx, gy, hessian, j1, jf, moments):  # type: ignore[no-untyped-def]
    """Fill the sums of J J^T, J and J f over a subset, and of f, f^2, dx^2, dy^2.

    J = (gx, gx dx, gx dy, gy, gy dx, gy dy).
    """
    h = np.zeros(18)
    s = np.zeros(12)
    m = np.zeros(4)
    for k in range(count):
        x = dx[k]
        y = dy[k]
        v = f[k]
        xx = x * x
        xy = x * y
        yy = y * y
        p = gx[k]
        q = gy[k]
        a = p * p
        b = p * q
        c = q * q
        h[0] += a
        h[1] += a * x
        h[2] += a * y
        h[3] += a * xx
        h[4] += a * xy
        h[5] += a * yy
        h[6] += b
        h[7] += b * x
        h[8] += b * y
        h[9] += b * xx
        h[10] += b * xy
        h[11] += b * yy
        h[12] += c
        h[13] += c * x
        h[14] += c * y
        h[15] += c * xx
        h[16] += c * xy
        h[17] += c * yy
        s[0] += p
        s[1] += p * x
        s[2] += p * y
        s[3] += q
        s[4] += q * x
        s[5] += q * y
        p *= v
        q *= v
        s[6] += p
        s[7] += p * x
        s[8] += p * y
        s[9] += q
        s[10] += q * x
        s[11] += q * y
        m[0] += v
        m[1] += v * v
        m[2] += xx
        m[3] += yy
    for block, r, c0 in ((0, 0, 0), (1, 0, 3), (2, 3, 3)):
        t = h[6 * block : 6 * block + 6]
        hessian[r, c0] = t[0]
        hessian[r, c0 + 1] = hessian[r + 1, c0] = t[1]
        hessian[r, c0 + 2] = hessian[r + 2, c0] = t[2]
        hessian[r + 1, c0 + 1] = t[3]
        hessian[r + 1, c0 + 2] = hessian[r + 2, c0 + 1] = t[4]
        hessian[r + 2, c0 + 2] = t[5]
    for i in range(3):
        for j in range(3):
            hessian[3 + i, j] = hessian[j, 3 + i]
    j1[:] = s[:6]
    jf[:] = s[6:]
    moments[:] = m


@summing_kernel
def _deformed_sums(count, dx, dy, f, gx, gy, g, jg, moments):  # type: ignore[no-untyped-def]
    """Fill the sums of J g, and of g, g^2 and f g, over a subset."""
    s = np.zeros(9)
    for k in range(count):
        v = g[k]
        s[0] += v
        s[1] += v * v
        s[2] += v * f[k]
        a = gx[k] * v
        b = gy[k] * v
        s[3] += a
        s[4] += a * dx[k]
        s[5] += a * dy[k]
        s[6] += b
        s[7] += b * dx[k]
        s[8] += b * dy[k]
    moments[:] = s[:3]
    jg[:] = s[3:]


@kernel
def _invert(matrix, inverse):  # type: ignore[no-untyped-def]
    """Invert a positive definite 6 x 6 matrix by Cholesky's method; return False where it is not one.

    It is scaled to a unit diagonal first, so "not one" means singular to a part in 10^9 whatever the units.
    """
    n = matrix.shape[0]
    scale = np.empty(n)
    for i in range(n):
        if not matrix[i, i] > 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(matrix[i, i])
    lower = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 1e-9:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    half = np.zeros((n, n))  # the inverse of `lower`
    for i in range(n):
        half[i, i] = 1.0 / lower[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= lower[i, k] * half[k, j]
            half[i, j] = total / lower[i, i]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(max(i, j), n):
                total += half[k, i] * half[k, j]
            inverse[i, j] = total * scale[i] * scale[j]
    return True


@kernel
def _compose_inverse(warp, step):  # type: ignore[no-untyped-def]
    """Replace the warp W(p) by W(p) o W(step)^-1; both displacements, (u, ux, uy, v, vx, vy)."""
    a = 1.0 + step[1]
    b = step[2]
    c = step[4]
    d = 1.0 + step[5]
    determinant = a * d - b * c
    # The inverse step maps x to M (x - t), M = [[d, -b], [-c, a]] / determinant.
    m00 = d / determinant
    m01 = -b / determinant
    m10 = -c / determinant
    m11 = a / determinant
    tx = -(m00 * step[0] + m01 * step[3])
    ty = -(m10 * step[0] + m11 * step[3])
    p00 = 1.0 + warp[1]
    p01 = warp[2]
    p10 = warp[4]
    p11 = 1.0 + warp[5]
    warp[0] += p00 * tx + p01 * ty
    warp[3] += p10 * tx + p11 * ty
    warp[1] = p00 * m00 + p01 * m10 - 1.0
    warp[2] = p00 * m01 + p01 * m11
    warp[4] = p10 * m00 + p11 * m10
    warp[5] = p10 * m01 + p11 * m11 - 1.0


@kernel
def _match_block(  # type: ignore[no-untyped-def]
    start, stop, reference, gradient_x, gradient_y, coefficients, labels, noise,
    x, y, radius, minimum, tolerance, limit, warp, sigma, score, iterations, ending,
):  # fmt: skip
    """Match points start .. stop; `warp` holds the guesses and is overwritten."""
    rows, columns = labels.shape
    size = (2 * radius + 1) ** 2
    dx, dy, f, gx, gy, g = (
        np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size),
    )  # fmt: skip
    hessian = np.empty((6, 6))
    inverse = np.empty((6, 6))
    j1 = np.empty(6)
    jf = np.empty(6)
    jg = np.empty(6)
    step = np.empty(6)
    moments = np.empty(3)
    levels = np.empty(4)
    affine = np.empty(6)
    box = np.empty(4, dtype=np.int64)
    for point in range(start, stop):
        cx = x[point]
        cy = y[point]
        p = warp[point]
        u0 = p[0]
        v0 = p[3]
        n = _collect(reference, gradient_x, gradient_y, labels, cx, cy, radius, p, dx, dy, f, gx, gy, box)
        if n < minimum:
            ending[point] = TOO_FEW_PIXELS
            continue
        _reference_sums(n, dx, dy, f, gx, gy, hessian, j1, jf, levels)
        mean = levels[0] / n
        ff = levels[1] - levels[0] * mean
        variance = noise[0] + noise[1] * mean
        # Eliminating gain and offset takes from every slope its share of a constant and of the subset.
        for i in range(6):
            jf[i] -= mean * j1[i]
        for i in range(6):
            for j in range(6):
                hessian[i, j] -= j1[i] * j1[j] / n + jf[i] * jf[j] / ff
        if not ff > 4.0 * n * variance or not _invert(hessian, inverse):
            ending[point] = NO_TEXTURE
            continue
        before = np.inf
        gg = 0.0
        for iteration in range(limit):
            if not _inside(p, cx, cy, box[0], box[1], box[2], box[3], rows, columns, _REACH):
                ending[point] = LEFT_IMAGE
                break
            affine[0] = cx + p[0]
            affine[1] = 1.0 + p[1]
            affine[2] = p[2]
            affine[3] = cy + p[3]
            affine[4] = p[4]
            affine[5] = 1.0 + p[5]
            spline_values(coefficients, n, dx, dy, affine, g)
            _deformed_sums(n, dx, dy, f, gx, gy, g, jg, moments)
            gg = moments[1] - moments[0] ** 2 / n
            fg = moments[2] - moments[0] * mean
            iterations[point] = iteration + 1
            if not (fg > 0.0 and gg > 0.0):
                break
            score[point] = fg / np.sqrt(ff * gg)
            for i in range(6):
                step[i] = 0.0
                for j in range(6):
                    residual = jg[j] - moments[0] / n * j1[j] - fg / ff * jf[j]
                    step[i] += inverse[i, j] * residual * ff / fg
            _compose_inverse(p, step)
            if not abs(p[0] - u0) + abs(p[3] - v0) < _WANDER:
                break
            movement = (
                step[0] ** 2 + step[3] ** 2
                + ((step[1] ** 2 + step[4] ** 2) * levels[2] + (step[2] ** 2 + step[5] ** 2) * levels[3]) / n
            )  # fmt: skip
            # Steps shrink at least geometrically, so the last two bound all that would follow.
            ratio = movement / before if iteration > 0 else 1.0
            if movement < tolerance**2 or (ratio < 0.25 and movement * ratio < 0.25 * tolerance**2):
                ending[point] = CONVERGED
                break
            before = movement
        if ending[point] == CONVERGED:
            # Both images are noisy; what the fit leaves over counts where it is more than their noise.
            variance += ff / gg * (noise[2] + noise[3] * moments[0] / n)
            variance = max(variance, 2.0 * ff * (1.0 - score[point]) / max(n - 8, 1))
            sigma[point, 0] = np.sqrt(variance * inverse[0, 0])
            sigma[point, 1] = np.sqrt(variance * inverse[3, 3])


def match_points(
    images: PreparedImages,
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    guess: Floats,
    settings: MatchSettings,
    threads: int = 1,
) -> Matches:
    """Find where the subsets about points of the reference image lie in the deformed one.

    Parameters
    ----------
    images
        The two images.
    x, y
        (n,), pixels of the reference image on a region.
    guess
        (n, 6): u, du/dx, du/dy, v, dv/dx, dv/dy; in px, right to about a speckle's radius.
    settings
        Size of the subsets and when to stop.
    threads
        How many threads to use.

    Returns
    -------
    `warp` (n, 6) in the order of `guess`; `sigma` (n, 2), the standard deviations of u and v in px;
    `score` (n,), the zero-normalised cross-correlation; `iterations` and `ending` (n,).

    Notes
    -----
    Baker & Matthews 2004, Pan et al. 2013, with the first-order shape function of thesis Eq. (1.2). With
    J the slopes of f, H = sum J J^T less the parts along 1 and f, the step is
    (sum f^2 / sum f g) H^-1 sum J~ g and the covariance s^2 H^-1. s^2 is the sum of both images' noise
    variances, or the residual's where that is larger. The noise model is the base since interpolation
    smooths the residual (but not the match, which rests on slow grey level changes) by up to a third, and
    the residual is what shows an affine subset that does not fit.
    """
    result = Matches(
        np.array(guess, dtype=np.float64),
        np.full((len(x), 2), np.nan),
        np.full(len(x), np.nan),
        np.zeros(len(x), dtype=np.int32),
        np.full(len(x), NOT_CONVERGED, dtype=np.int32),
    )
    noise = np.array([term for model in images.noise for term in (model.floor, model.slope)])
    minimum = max(int(settings.minimum_part * (2 * settings.radius + 1) ** 2), 16)

    def work(start: int, stop: int) -> None:
        _match_block(
            start, stop, images.reference, images.gradient_x, images.gradient_y, images.coefficients,
            images.labels, noise, x, y, settings.radius, minimum, settings.tolerance, settings.iterations,
            result.warp, result.sigma, result.score, result.iterations, result.ending,
        )  # fmt: skip

    in_row_blocks(work, len(x), threads)
    return result
