"""Subsets that follow more and are noisier, where what the images ask for is more than that noise.

The bias that `verify_displacement` finds tells where subsets could not follow. There points are matched again
by subsets that can, and of the two displacements each pixel takes the one whose mean square error is less:
variance by noise and bias together (the trade-off of Blaber et al. 2015, at each pixel).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.deformation.matching.verification import Verified

_FINER = 0.7  # of the radius: subsets of second order that have the noise of a first order of half the radius
_LEAST_RADIUS = 5  # px: a second order wants some speckles to tell its twelve numbers from
_NOISIER = 2.0  # variance of the next finer subsets over that of those before: what bias has to exceed


@dataclass(frozen=True)
class Subsets:
    """Which subsets are matched: their radius in px, and the order of their deformation."""

    radius: int
    order: ShapeOrder


def ladder(first: Subsets) -> tuple[Subsets, ...]:
    """Return subsets from those that are least noisy to those that follow most, the given ones first."""
    finer = Subsets(max(round(_FINER * first.radius), _LEAST_RADIUS), 2)
    steps = [first, Subsets(first.radius, 2), finer]
    return tuple(one for n, one in enumerate(steps) if one not in steps[:n] and one.radius <= first.radius)


@dataclass(frozen=True)
class Verdict:
    """A displacement at every pixel, and what is known of its errors.

    Attributes
    ----------
    value, variance
        (2, rows, columns): u and v in px and their variances by noise in px^2.
    verified
        What the images say of it.
    step
        (rows, columns): which step of the ladder each pixel has taken.
    """

    value: Floats
    variance: Floats
    verified: Verified
    step: NDArray[np.uint8]

    @property
    def mean_square(self) -> Floats:
        """(rows, columns), of the error in px^2, u and v together; NaN where there is no value."""
        square = (self.variance + self.verified.bias).sum(axis=0)
        return np.where(np.isfinite(self.value).all(axis=0), square, np.nan)


def worth_trying(now: Verdict) -> Mask:
    """Return the pixels whose bias is more than the noise that finer subsets would add."""
    with np.errstate(invalid="ignore"):
        more = now.verified.bias.sum(axis=0) > (_NOISIER - 1.0) * now.variance.sum(axis=0)
    return np.asarray(np.isfinite(now.value[0]) & (more | ~now.verified.agrees))


def better_of(now: Verdict, finer: Verdict, radius: int) -> Verdict:
    """Return the displacement that has the smaller mean square error, about each pixel.

    Over squares of half a subset's radius, in which both are known; from the one to the other over as many
    pixels, so that there is no step for strain to see.
    """
    known = np.isfinite(now.mean_square) & np.isfinite(finer.mean_square)
    size = 2 * max(radius // 2, 1) + 1
    share = ndimage.uniform_filter(known.astype(np.float64), size)
    gain = np.where(known, now.mean_square - finer.mean_square, 0.0)
    better = known & (ndimage.uniform_filter(gain, size) > 0.0) & (share > 0.0)
    part = np.where(known, ndimage.uniform_filter(better.astype(np.float64), size), 0.0)
    part[better & ~now.verified.agrees & finer.verified.agrees] = 1.0

    def mixed(coarse: Floats, fine: Floats) -> Floats:
        return np.where(part > 0.0, (1.0 - part) * coarse + part * np.where(known, fine, 0.0), coarse)

    chosen = part >= 0.5
    verified = Verified(
        mixed(now.verified.bias, finer.verified.bias),
        np.where(chosen, finer.verified.agrees, now.verified.agrees),
        np.where(chosen, finer.verified.unlike, now.verified.unlike),
    )
    return Verdict(
        mixed(now.value, finer.value),
        mixed(now.variance, finer.variance),
        verified,
        np.where(chosen, finer.step, now.step),
    )
