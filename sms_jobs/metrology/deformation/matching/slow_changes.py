"""What two images do not share and that changes slowly: dust on the sensor, light, reflections.

Matching takes a mean and a gain off each subset. Of what changes within it besides, a part moves the match,
since the texture has slow changes too; the rest is left in the residual, where white noise has hardly any:
its mean over some pixels is far larger than noise leaves. As much as it is larger in variance, as much more
do the slow changes of the texture let it move the match, as long as nothing tells how the two agree.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.compilation import uncounted_kernel
from sms_jobs.metrology.deformation.matching.window_maps import means

_LEFT_BY_FIT = 0.6
"""Of the noise of means, after a subset of 21 px and first order, its mean and gain; by trial. One of 11 px
leaves 0.35, one of 41 px 0.75, but there a fiftieth of the texture changes so slowly."""
_SURE = 3.0  # standard deviations from which on larger means are no chance
_LEAST_SHARE = 1e-3  # of a mean's pixels: less than one of any
_DEPENDENT = 0.7  # of a mean's pixels: neighbours that count as one, as in windows; by trial


@uncounted_kernel
def _relative_squares(
    total: Floats, share: Floats, noise: Floats, known: Mask, left: float, squares: Floats
) -> None:
    """Fill in squared means in units of their noise, from those of what is alike, and of its part."""
    rows, columns = known.shape
    for r in range(rows):
        for c in range(columns):
            usable = known[r, c] and share[r, c] > _LEAST_SHARE
            square = total[r, c] * total[r, c] / share[r, c] if usable else 0.0
            squares[r, c] = square / (left * noise[r, c]) if usable else 0.0


@uncounted_kernel
def _as_variance(
    times: Floats, part: Floats, noise: Floats, own: Floats, slow: Floats, known: Mask, least: float,
    found: Floats,
) -> None:  # fmt: skip
    """Fill in what means so many `times` larger add to the variance of a match; 0 up to the `least`.

    `part` is that of each subset that is known, of which `times` are sums; `own` and `slow` are the mean
    squares of the texture's slopes, and of the slow part of these.
    """
    rows, columns = known.shape
    for r in range(rows):
        for c in range(columns):
            more = times[r, c] / part[r, c] if known[r, c] else 0.0
            sure = more > least and own[r, c] > 0.0
            share = slow[r, c] / own[r, c] if sure else 0.0
            found[r, c] = (more - 1.0) * share * noise[r, c] / own[r, c] if sure else 0.0


def moved_by_slow_changes(
    residual: Floats,
    slopes: tuple[Floats, Floats],
    slow_slopes: tuple[Floats, Floats],
    noise: Floats,
    like: Mask,
    known: Mask,
    radii: tuple[int, int],
) -> tuple[Floats, Floats]:
    """Return the variances of u and v by what changes slowly, (rows, columns) in px^2; 0 where it is chance.

    Parameters
    ----------
    residual
        (rows, columns), what a match has left, in grey levels; 0 where not `known`.
    slopes, slow_slopes
        Of the texture along x and y, per px, and their means.
    noise
        Variance of a pixel's residual by noise, as if it were white.
    like, known
        Pixels that show one thing in both images, and all that are there.
    radii
        In px, of the subsets and of the means: half a side.
    """
    subset, mean = radii
    pixels, all_pixels = (2 * mean + 1) ** 2, (2 * subset + 1) ** 2
    left = _LEFT_BY_FIT * (1.0 / pixels - 1.0 / all_pixels)
    total, share = means(np.where(like, residual, 0.0), mean), means(like.astype(np.float64), mean)
    squares = np.empty(known.shape)
    _relative_squares(total, share, noise, known, left, squares)
    times, part = means(squares, subset), means(known.astype(np.float64), subset)
    least = 1.0 + _SURE * sqrt(2.0 * _DEPENDENT * pixels / all_pixels)
    of_subset = noise / all_pixels
    found = (np.empty(known.shape), np.empty(known.shape))
    for slope, slow_slope, variance in zip(slopes, slow_slopes, found, strict=True):
        own, slow = means(slope * slope, subset), means(slow_slope * slow_slope, subset)
        _as_variance(times, part, of_subset, own, slow, known, least, variance)
    return found
