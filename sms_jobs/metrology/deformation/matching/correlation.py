"""Inverse-compositional Gauss-Newton matching of subsets that are cut to one region.

A subset holds the pixels of a square that lie on the same continuous region as its centre (thesis section
4.3.2), so pieces of surface that move apart are never matched as one. Matching minimises the zero-normalised
sum of squared differences, f(x) = a g(W(x)) + b, with the gain a and offset b eliminated exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Labels
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel
from sms_jobs.metrology.deformation.matching.normal_matrix import invert
from sms_jobs.metrology.deformation.matching.shape_functions import (
    PARAMETERS,
    WARP,
    ShapeOrder,
    compose_inverse,
    inside,
    places,
)
from sms_jobs.metrology.deformation.matching.subsets import (
    collect,
    deformed_sums,
    reference_sums,
)
from sms_jobs.metrology.images.spline import (
    KERNEL_CODE,
    PADDING,
    Interpolant,
    spline_coefficients,
    spline_gradient,
    spline_values,
)

CONVERGED, TOO_FEW_PIXELS, NO_TEXTURE, LEFT_IMAGE, NOT_CONVERGED, AMBIGUOUS = range(6)
"""How the matching of a point ended."""

_REACH = PADDING - 3.0  # px that a subset may run over the image's border, on the reflected spline
_UNSHARED = 8.0  # rate at which steps shrink over the decorrelation, 1 - score; by trial, on the safe side
_WANDER = 4.0  # px from the guess beyond which an iteration has lost its subset

Spots: TypeAlias = tuple[float, float]
"""Variances in px^2 of the spots that a reference and a deformed image show of a point."""


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
    shape_order
        Of the subsets' deformation: 0 shift, 1 affine, 2 quadratic.
    """

    radius: int = 16
    minimum_part: float = 0.2
    tolerance: float = 5e-4
    iterations: int = 20
    shape_order: ShapeOrder = 1


@dataclass(frozen=True)
class PreparedImages:
    """A reference and a deformed image, ready to be matched at any number of points.

    Attributes
    ----------
    reference, deformed
        (rows, columns), in grey levels.
    gradient_x, gradient_y
        Slopes of the reference image at its pixels, in grey levels a pixel.
    coefficients, reference_coefficients
        Of the splines through the deformed and the reference image.
    labels
        (rows, columns), continuous regions of the reference image, 0 for none.
    noise
        Of the reference and of the deformed image.
    interpolant
        The kind of the splines.
    spots
        Variance in px^2 of the spot that the reference and the deformed image show of a point; 0 where both
        show the specimen alike.
    """

    reference: Floats
    gradient_x: Floats
    gradient_y: Floats
    deformed: Floats
    coefficients: Floats
    reference_coefficients: Floats
    labels: NDArray[np.int32]
    noise: tuple[Noise, Noise]
    interpolant: Interpolant
    spots: Spots = (0.0, 0.0)

    def way_back(self) -> PreparedImages:
        """Return the images the other way round, to match the deformed one, all of which is one region."""
        everywhere = np.ones(self.deformed.shape, dtype=np.int32)
        return _prepared(
            (self.deformed, self.coefficients),
            (self.reference, self.reference_coefficients),
            everywhere,
            self.noise[::-1],
            self.interpolant,
            self.spots[::-1],
        )


@dataclass(frozen=True)
class Matches:
    """Results at n points: see `match_points`."""

    warp: Floats
    sigma: Floats
    score: Floats
    iterations: NDArray[np.int32]
    ending: NDArray[np.int32]
    misfit: Floats


def blank_matches(count: int, numbers: int) -> Matches:
    """Return room for matches at `count` points, whose warps have 6 or 12 numbers: none has converged."""
    return Matches(
        np.full((count, numbers), np.nan),
        np.full((count, 2), np.nan),
        np.full(count, np.nan),
        np.zeros(count, dtype=np.int32),
        np.full(count, NOT_CONVERGED, dtype=np.int32),
        np.full(count, np.nan),
    )


def least_pixels(settings: MatchSettings) -> int:
    """Return how many pixels a subset must have to be matched."""
    whole = (2 * settings.radius + 1) ** 2
    return max(int(settings.minimum_part * whole), 16, 3 * PARAMETERS[settings.shape_order])


def prepare_images(
    reference: NDArray[np.generic],
    deformed: NDArray[np.generic],
    labels: NDArray[np.int32],
    noise: tuple[Noise, Noise] = (Noise(0.0, 0.0), Noise(0.0, 0.0)),
    interpolant: Interpolant = "quintic",
    spots: Spots = (0.0, 0.0),
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
    interpolant
        Between the pixels of the deformed image; the slopes of the reference image are its own.
    spots
        Variance in px^2 of what the reference and the deformed image have been blurred by.
    """
    first, second = (
        (np.ascontiguousarray(image, dtype=np.float64), spline_coefficients(image, interpolant))
        for image in (reference, deformed)
    )
    return _prepared(first, second, np.ascontiguousarray(labels, dtype=np.int32), noise, interpolant, spots)


def _prepared(
    reference: tuple[Floats, Floats],
    deformed: tuple[Floats, Floats],
    labels: Labels,
    noise: tuple[Noise, Noise],
    interpolant: Interpolant,
    spots: Spots,
) -> PreparedImages:
    """Return two images, each with the coefficients of its spline, ready to be matched."""
    slopes = spline_gradient(reference[1], interpolant)
    return PreparedImages(
        reference[0], *slopes, deformed[0], deformed[1], reference[1], labels, noise, interpolant, spots
    )


@inner
@uncounted_kernel
def _eliminate_light(
    count: int, f_mean: float, ff: float, terms: int, hessian: Floats, j1: Floats, jf: Floats
) -> None:
    """Take from the slopes their parts along a constant and along the subset: no offset, no gain is left.

    `jf` becomes the sum of J (f - mean), `hessian` the normal matrix of the displacement alone.
    """
    for i in range(terms):
        jf[i] -= f_mean * j1[i]
    for i in range(terms):
        for j in range(terms):
            hessian[i, j] -= j1[i] * j1[j] / count + jf[i] * jf[j] / ff


@inner
@kernel
def _invert_for(order: int, hessian: Floats, inverse: Floats) -> bool:
    """Invert the normal matrix of the unknowns of an order; the inverse is zero for anything else."""
    if order > 0:
        return invert(hessian, inverse)
    shift = np.array([[hessian[0, 0], hessian[0, 3]], [hessian[3, 0], hessian[3, 3]]])
    inverted = np.empty((2, 2))
    regular = invert(shift, inverted)
    inverse[:] = 0.0
    inverse[0, 0], inverse[0, 3] = inverted[0, 0], inverted[0, 1]
    inverse[3, 0], inverse[3, 3] = inverted[1, 0], inverted[1, 1]
    return regular


@inner
@uncounted_kernel
def _movement(step: Floats, n: int, box: Ints, levels: Floats) -> float:
    """Return the rms movement of a subset's pixels by a step, in px; at most, where it is quadratic."""
    xx, yy = levels[2] / n, levels[3] / n
    square = step[0] ** 2 + step[3] ** 2
    square += (step[1] ** 2 + step[4] ** 2) * xx + (step[2] ** 2 + step[5] ** 2) * yy
    left, top = max(abs(box[0]), abs(box[1])), max(abs(box[2]), abs(box[3]))
    square += 0.25 * (step[6] ** 2 + step[9] ** 2) * xx * left**2
    square += (step[7] ** 2 + step[10] ** 2) * xx * top**2
    square += 0.25 * (step[8] ** 2 + step[11] ** 2) * yy * top**2
    return float(np.sqrt(square))


@inner
@kernel
def _refine(
    subset: tuple[int, int, int, Floats, Floats, Floats, Floats, Floats, Ints],
    reference: tuple[float, float, Floats, Floats, Floats, Floats],
    coefficients: Floats,
    shape: tuple[int, int],
    orders: tuple[int, int],
    stop: tuple[float, int],
    p: Floats,
    room: tuple[Floats, Floats, Floats, Ints],
) -> tuple[int, int, float, float, float]:
    """Iterate a subset's warp `p`; return how it ended, the iterations, score, and mean and spread of g.

    `subset` is (x, y, count, dx, dy, f, gx, gy, box), `reference` (mean f, sum of (f - mean)^2, the inverse
    of the normal matrix, sums of J, of J (f - mean), and of f, f^2, dx^2, dy^2), `orders` that of the shape
    and the spline's code, `stop` the tolerance and the most iterations.
    """
    cx, cy, n, dx, dy, f, gx, gy, box = subset
    f_mean, ff, inverse, j1, jf, levels = reference
    g, s, t, first = room
    order, spline = orders
    terms = inverse.shape[0]
    jg, step, residual = np.empty(WARP), np.zeros(WARP), np.empty(WARP)
    moments = np.empty(3)
    u0, v0 = p[0], p[3]
    score, g_mean, gg = np.nan, np.nan, np.nan
    for iteration in range(1, stop[1] + 1):
        if not inside(p, cx, cy, box[0], box[1], box[2], box[3], shape[0], shape[1], _REACH):
            return LEFT_IMAGE, iteration, score, g_mean, gg
        places(p, order, cx, cy, coefficients.shape[1], n, dx, dy, first, s, t)
        spline_values(coefficients, spline, n, first, s, t, g)
        deformed_sums(n, dx, dy, f, gx, gy, g, order, jg, moments)
        g_mean = moments[0] / n
        gg = moments[1] - moments[0] * g_mean
        fg = moments[2] - moments[0] * f_mean
        if not (fg > 0.0 and gg > 0.0):
            break
        # The step takes from the residual what its square in the metric of the normal matrix is worth.
        gained = 0.0
        for i in range(terms):
            residual[i] = (jg[i] - g_mean * j1[i] - fg / ff * jf[i]) * ff / fg
        for i in range(terms):
            step[i] = 0.0
            for j in range(terms):
                step[i] += inverse[i, j] * residual[j]
            gained += step[i] * residual[i]
        score = min(np.sqrt(fg * fg / (ff * gg) + gained / ff), 1.0)
        compose_inverse(p, step)
        if not abs(p[0] - u0) + abs(p[3] - v0) < _WANDER:
            break
        movement = _movement(step, n, box, levels)
        # Steps shrink at a rate that grows with the step itself (the spline bends over about a pixel) and
        # with what the two images do not share: that bounds what is left.
        rate = min(movement + _UNSHARED * (1.0 - score), 0.95)
        if movement * rate < stop[0] * (1.0 - rate):
            return CONVERGED, iteration, score, g_mean, gg
    return NOT_CONVERGED, iteration, score, g_mean, gg


@kernel
def _match_block(
    start: int, stop: int,
    images: tuple[Floats, Floats, Floats, Floats, Labels], noise: Floats, spots: tuple[float, float],
    x: Ints, y: Ints, radius: int, minimum: int, orders: tuple[int, int], ends: tuple[float, int],
    warp: Floats, sigma: Floats, score: Floats, iterations: Labels, ending: Labels, misfit: Floats,
) -> None:  # fmt: skip
    """Match points start .. stop; `warp` holds the guesses and is overwritten."""
    reference, gradient_x, gradient_y, coefficients, labels = images
    size = (2 * radius + 1) ** 2
    dx, dy, f = np.empty(size), np.empty(size), np.empty(size)
    gx, gy = np.empty(size), np.empty(size)
    room = (np.empty(size), np.empty(size), np.empty(size), np.empty(size, dtype=np.int64))
    terms = WARP if orders[0] > 1 else 6
    unknowns = PARAMETERS[orders[0]] + 2  # and the light's gain and offset
    hessian, inverse = np.empty((terms, terms)), np.empty((terms, terms))
    j1, jf, levels = np.empty(WARP), np.empty(WARP), np.empty(4)
    box = np.empty(4, dtype=np.int64)
    for k in range(start, stop):
        p = warp[k]
        n = collect(
            reference, gradient_x, gradient_y, labels, x[k], y[k], radius, p, spots, dx, dy, f, gx, gy, box
        )
        if n < minimum:
            ending[k] = TOO_FEW_PIXELS
            continue
        reference_sums(n, dx, dy, f, gx, gy, orders[0], hessian, j1, jf, levels)
        f_mean = levels[0] / n
        ff = levels[1] - levels[0] * f_mean
        variance = noise[0] + noise[1] * f_mean
        _eliminate_light(n, f_mean, ff, terms, hessian, j1, jf)
        if not ff > 4.0 * n * variance or not _invert_for(orders[0], hessian, inverse):
            ending[k] = NO_TEXTURE
            continue
        subset = (x[k], y[k], n, dx, dy, f, gx, gy, box)
        sums = (f_mean, ff, inverse, j1, jf, levels)
        ending[k], iterations[k], score[k], g_mean, gg = _refine(
            subset, sums, coefficients, labels.shape, orders, ends, p, room
        )
        if ending[k] == CONVERGED:
            # Both images are noisy; what the fit leaves over counts where it is more than their noise.
            variance += ff / gg * (noise[2] + noise[3] * g_mean)
            left_over = 2.0 * ff * (1.0 - score[k]) / max(n - unknowns, 1)
            misfit[k] = left_over / variance
            variance = max(variance, left_over)
            sigma[k, 0] = np.sqrt(variance * inverse[0, 0])
            sigma[k, 1] = np.sqrt(variance * inverse[3, 3])


def match_points(
    images: PreparedImages,
    x: Ints,
    y: Ints,
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
        (n, 6): u, du/dx, du/dy, v, dv/dx, dv/dy; in px, right to about a speckle's radius. Or (n, 12), with
        the second derivatives u,xx u,xy u,yy v,xx v,xy v,yy; only the second order takes them.
    settings
        Size of the subsets and when to stop.
    threads
        How many threads to use.

    Returns
    -------
    `warp` (n, 6), or (n, 12) of second order, in the order of `guess`; `sigma` (n, 2), the standard
    deviations of u and v in px; `score` (n,), the zero-normalised cross-correlation; `iterations` and
    `ending` (n,); `misfit` (n,), the variance that the fit leaves over, in units of that of both images'
    noise: about 1, less what interpolation smooths, where the subset is what it is taken for.

    Notes
    -----
    Baker & Matthews 2004, Pan et al. 2013, with the first-order shape function of thesis Eq. (1.2); the
    second order as in Gao et al. 2015, the zeroth with the guess's gradients as they are. With J the
    slopes of f, H = sum J J^T less the parts along 1 and f, the step is (sum f^2 / sum f g) H^-1 sum J~ g
    and the covariance s^2 H^-1. s^2 is the sum of both images' noise variances, or the residual's where
    that is larger. The noise model is the base since interpolation smooths the residual (but not the
    match, which rests on slow grey level changes) by up to a third, and
    the residual is what shows a subset whose shape does not fit.

    Where the images have `spots` s_0 and s_1, f is what the deformed image shows of it: a subset that is half
    as wide there is blurred twice as far, and that is no noise. To f is added half of s_1 (F^T F)^-1 - s_0
    times its second derivatives, with F of the guess.
    """
    warp = np.zeros((len(x), WARP))
    numbers = min(guess.shape[1], WARP if settings.shape_order == 2 else 6)
    warp[:, :numbers] = guess[:, :numbers]
    blank = blank_matches(len(x), 0)
    result = replace(blank, warp=warp if settings.shape_order == 2 else warp[:, :6])
    noise = np.array([term for model in images.noise for term in (model.floor, model.slope)])
    minimum = least_pixels(settings)
    pixels = (images.reference, images.gradient_x, images.gradient_y, images.coefficients, images.labels)
    orders = (int(settings.shape_order), KERNEL_CODE[images.interpolant])
    ends = (settings.tolerance, settings.iterations)

    def work(start: int, stop: int) -> None:
        _match_block(
            start, stop, pixels, noise, images.spots, x, y, settings.radius, minimum, orders, ends,
            warp, result.sigma, result.score, result.iterations, result.ending, result.misfit,
        )  # fmt: skip

    in_row_blocks(work, len(x), threads, block=128)
    return result
