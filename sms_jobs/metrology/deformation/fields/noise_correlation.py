"""What blended matches make of the noise of single pixels, and what two kinds of them have in common."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import fft

from sms_jobs.metrology.arrays import Floats, Labels
from sms_jobs.metrology.deformation.fields.border_noise import RADIUS, by_borders, seen_beside_a_border
from sms_jobs.metrology.deformation.fields.displacement import blending_factor, blending_reach
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.matching.shape_functions import WARP

_TERMS = (1, 3, 6)
"""Numbers of a displacement that subsets of an order know: its value, slopes, second derivatives."""


def _terms(half: int, order: int) -> Floats:
    """Return what each number of a displacement adds at places within `half` of it, (terms, side, side)."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    return np.stack([np.ones_like(x), x, y, 0.5 * x**2, x * y, 0.5 * y**2])[: _TERMS[order]]


@cache
def blended_weights(subsets: Subsets) -> tuple[Floats, float]:
    """Return what pixels (side, side) weigh in a blended match, and the variance that is stated of it.

    The latter in units of what a single pixel would have.
    """
    numbers = WARP if subsets.order == 2 else 6
    terms = _terms(subsets.radius, subsets.order)
    fit = np.linalg.pinv(terms.reshape(len(terms), -1)).T.reshape(terms.shape)
    reach = blending_reach(subsets.radius, numbers)
    wide = int(np.ceil(reach))
    y, x = np.mgrid[-wide : wide + 1, -wide : wide + 1]
    blend = np.maximum(1.0 - (x**2 + y**2) / reach**2, 0.0) ** 2
    # A match that lies to one side says what is on its other.
    said = blend / blend.sum() * _terms(wide, subsets.order)[:, ::-1, ::-1]
    side = 2 * (wide + subsets.radius) + 1
    spectra = (fft.rfft2(one, (side, side)) for one in (said, fit))
    weights = fft.irfft2(np.multiply(*spectra).sum(axis=0), (side, side))
    return np.asarray(weights), blending_factor(numbers) * float(np.sum(fit[0] ** 2))


@cache
def noise_correlation(first: Subsets, second: Subsets) -> float:
    """Return the correlation of two blended matches of one noisy image, by subsets about the same pixel.

    Notes
    -----
    Where a texture is alike everywhere a match is a mean over the displacements that single pixels ask for,
    by the filter of least squares and blending; those of two matches share sum w v of their variances, and
    the correlation is sum w v over the deviations that `blend_matches` states. How far apart the matches of a
    grid are changes these, but not the sum.
    """
    (w, of_first), (v, of_second) = blended_weights(first), blended_weights(second)
    small, large = sorted((w, v), key=len)
    off = (len(large) - len(small)) // 2
    inner = large[off : off + len(small), off : off + len(small)]
    return float(np.sum(small * inner) / np.sqrt(of_first * of_second))


def noise_correlation_at(labels: Labels, first: Subsets, second: Subsets, margin: int) -> Floats:
    """Return that correlation at pixels (rows, columns): beside borders matches have less in common.

    It is what they share over the noise that `blend_matches` states.
    `labels` (rows, columns) are the regions that the first are cut to; the second's go `margin` px further.
    """
    far = noise_correlation(first, second)
    if not first.order or not second.order:
        return np.full(labels.shape, far)
    largest = max(first.radius, second.radius)
    small = [
        max(round((one.radius + 0.5) * (RADIUS + 0.5) / (largest + 0.5) - 0.5), 2) for one in (first, second)
    ]
    orders = first.order, second.order
    inwards = round(margin * (RADIUS + 0.5) / (largest + 0.5))
    (less,) = by_borders(
        labels, largest, lambda rim: (_less_beside(orders, (small[0], small[1]), rim, 0 if rim else inwards),)
    )
    return far * less


@cache
def _less_beside(orders: tuple[int, int], radii: tuple[int, int], rim: int, margin: int) -> Floats:
    """Return the correlation beside a straight border over that far from it, at its `depths`."""
    first, second = (
        seen_beside_a_border(
            _TERMS[order], blending_reach(1, WARP if order == 2 else 6), rim, radius, inwards
        )
        for order, radius, inwards in zip(orders, radii, (margin, 0), strict=True)
    )
    shared = [
        float(np.sum(one.weights * other.weights) / np.sqrt(one.variance * other.variance))
        for one, other in zip(first, second, strict=True)
    ]
    return np.asarray(np.array(shared) / shared[-1])
