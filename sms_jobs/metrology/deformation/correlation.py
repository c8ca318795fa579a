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

from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.deformation.subsets import collect, deformed_sums, inside, reference_sums
from sms_jobs.metrology.images.interpolation import (
    PADDING,
    spline_coefficients,
    spline_gradient,
    spline_values,
)

Floats: TypeAlias = NDArray[np.float64]
Labels: TypeAlias = NDArray[np.int32]
Ints: TypeAlias = NDArray[np.int64]

CONVERGED, TOO_FEW_PIXELS, NO_TEXTURE, LEFT_IMAGE, NOT_CONVERGED = range(5)
"""How the matching of a point ended."""

_REACH = PADDING - 3.0  # px that a subset may run over the image's border, on the reflected spline
_UNSHARED = 8.0  # rate at which steps shrink over the decorrelation, 1 - score; by trial, on the safe side
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
        Rms movement of a subset's pixels, in px, that may be left when the iteration ends.
    iterations
        At most.
    """

    radius: int = 16
    minimum_part: float = 0.2
    tolerance: float = 5e-4
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
def _invert(
    matrix: Floats,
    inverse: Floats,
) -> bool:
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
def _compose_inverse(
    warp: Floats,
    step: Floats,
) -> None:
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
def _eliminate_light(count: int, f_mean: float, ff: float, hessian: Floats, j1: Floats, jf: Floats) -> None:
    """Take from the slopes their parts along a constant and along the subset: no offset, no gain is left.

    `jf` becomes the sum of J (f - mean), `hessian` the normal matrix of the displacement alone.
    """
    for i in range(6):
        jf[i] -= f_mean * j1[i]
    for i in range(6):
        for j in range(6):
            hessian[i, j] -= j1[i] * j1[j] / count + jf[i] * jf[j] / ff


@kernel
def _refine(
    subset: tuple[int, int, int, Floats, Floats, Floats, Floats, Floats, Ints],
    reference: tuple[float, float, Floats, Floats, Floats, Floats],
    coefficients: Floats,
    shape: tuple[int, int],
    tolerance: float,
    limit: int,
    p: Floats,
    g: Floats,
) -> tuple[int, int, float, float, float]:
    """Iterate a subset's warp `p`; return how it ended, the iterations, score, and mean and spread of g.

    `subset` is (x, y, count, dx, dy, f, gx, gy, box), `reference` (mean f, sum of (f - mean)^2, the inverse
    of the normal matrix, sums of J, of J (f - mean), and of f, f^2, dx^2, dy^2).
    """
    cx, cy, n, dx, dy, f, gx, gy, box = subset
    f_mean, ff, inverse, j1, jf, levels = reference
    jg = np.empty(6)
    step = np.empty(6)
    residual = np.empty(6)
    moments = np.empty(3)
    affine = np.empty(6)
    u0, v0 = p[0], p[3]
    score, g_mean, gg = np.nan, np.nan, np.nan
    for iteration in range(1, limit + 1):
        if not inside(p, cx, cy, box[0], box[1], box[2], box[3], shape[0], shape[1], _REACH):
            return LEFT_IMAGE, iteration, score, g_mean, gg
        affine[0], affine[1], affine[2] = cx + p[0], 1.0 + p[1], p[2]
        affine[3], affine[4], affine[5] = cy + p[3], p[4], 1.0 + p[5]
        spline_values(coefficients, n, dx, dy, affine, g)
        deformed_sums(n, dx, dy, f, gx, gy, g, jg, moments)
        g_mean = moments[0] / n
        gg = moments[1] - moments[0] * g_mean
        fg = moments[2] - moments[0] * f_mean
        if not (fg > 0.0 and gg > 0.0):
            break
        # The step takes from the residual what its square in the metric of the normal matrix is worth.
        gained = 0.0
        for i in range(6):
            residual[i] = (jg[i] - g_mean * j1[i] - fg / ff * jf[i]) * ff / fg
        for i in range(6):
            step[i] = 0.0
            for j in range(6):
                step[i] += inverse[i, j] * residual[j]
            gained += step[i] * residual[i]
        score = min(np.sqrt(fg * fg / (ff * gg) + gained / ff), 1.0)
        _compose_inverse(p, step)
        if not abs(p[0] - u0) + abs(p[3] - v0) < _WANDER:
            break
        square = step[0] ** 2 + step[3] ** 2
        square += (step[1] ** 2 + step[4] ** 2) * levels[2] / n
        square += (step[2] ** 2 + step[5] ** 2) * levels[3] / n
        movement = np.sqrt(square)
        # Steps shrink at a rate that grows with the step itself (the spline bends over about a pixel) and
        # with what the two images do not share: that bounds what is left.
        rate = min(movement + _UNSHARED * (1.0 - score), 0.95)
        if movement * rate < tolerance * (1.0 - rate):
            return CONVERGED, iteration, score, g_mean, gg
    return NOT_CONVERGED, iteration, score, g_mean, gg


@kernel
def _match_block(
    start: int,
    stop: int,
    reference: Floats,
    gradient_x: Floats,
    gradient_y: Floats,
    coefficients: Floats,
    labels: Labels,
    noise: Floats,
    x: Ints,
    y: Ints,
    radius: int,
    minimum: int,
    tolerance: float,
    limit: int,
    warp: Floats,
    sigma: Floats,
    score: Floats,
    iterations: Labels,
    ending: Labels,
) -> None:
    """Match points start .. stop; `warp` holds the guesses and is overwritten."""
    size = (2 * radius + 1) ** 2
    dx, dy, f = np.empty(size), np.empty(size), np.empty(size)
    gx, gy, g = np.empty(size), np.empty(size), np.empty(size)
    hessian, inverse = np.empty((6, 6)), np.empty((6, 6))
    j1, jf, levels = np.empty(6), np.empty(6), np.empty(4)
    box = np.empty(4, dtype=np.int64)
    for k in range(start, stop):
        p = warp[k]
        n = collect(reference, gradient_x, gradient_y, labels, x[k], y[k], radius, p, dx, dy, f, gx, gy, box)
        if n < minimum:
            ending[k] = TOO_FEW_PIXELS
            continue
        reference_sums(n, dx, dy, f, gx, gy, hessian, j1, jf, levels)
        f_mean = levels[0] / n
        ff = levels[1] - levels[0] * f_mean
        variance = noise[0] + noise[1] * f_mean
        _eliminate_light(n, f_mean, ff, hessian, j1, jf)
        if not ff > 4.0 * n * variance or not _invert(hessian, inverse):
            ending[k] = NO_TEXTURE
            continue
        subset = (x[k], y[k], n, dx, dy, f, gx, gy, box)
        sums = (f_mean, ff, inverse, j1, jf, levels)
        ending[k], iterations[k], score[k], g_mean, gg = _refine(
            subset, sums, coefficients, labels.shape, tolerance, limit, p, g
        )
        if ending[k] == CONVERGED:
            # Both images are noisy; what the fit leaves over counts where it is more than their noise.
            variance += ff / gg * (noise[2] + noise[3] * g_mean)
            variance = max(variance, 2.0 * ff * (1.0 - score[k]) / max(n - 8, 1))
            sigma[k, 0] = np.sqrt(variance * inverse[0, 0])
            sigma[k, 1] = np.sqrt(variance * inverse[3, 3])


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
