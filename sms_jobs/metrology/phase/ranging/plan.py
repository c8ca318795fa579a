"""What is the same for all pixels that are ranged, and when what is left of one may hold another return."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, kernel
from sms_jobs.metrology.phase.ranging.close_start import Grid
from sms_jobs.metrology.phase.ranging.transform import Transform
from sms_jobs.metrology.phase.ranging.weights import Sums, Weights

CLOSE_BINS = 1.6  # of 2 pi / s: the peaks of two returns nearer than this are no start for a fit of both

_TRIGGER = 0.85  # of the threshold, for a peak that is seen between samples


class Plan(NamedTuple):
    """What is the same for all pixels.

    Attributes
    ----------
    first, densities, least
        t of the first density, the number of densities s, and how many of them a pixel needs.
    threshold
        The score of a return, in standard deviations of noise, of `score_threshold`.
    variance, slope
        Variance of z at grey level 0, and its growth a grey level.
    unit
        Standard deviation of a frame over that of z.
    transform
        Of `transform_of`.
    weights, sums
        Of pixels that no density is left out of.
    overlaps, grid
        Of `overlap_table` and `grid`.
    """

    first: int
    densities: int
    least: int
    threshold: float
    variance: float
    slope: float
    unit: float
    transform: Transform
    weights: Weights
    sums: Sums
    overlaps: Floats
    grid: Grid


@inner
@kernel
def freedom(first: int, densities: int, returns: int) -> float:
    """Return the degrees of freedom that a number of returns leave a pixel of so many densities.

    Each density gives two real values, t = 0 one, and each return takes two.
    """
    return float(2 * densities - (1 if first == 0 else 0) - 2 * returns)


@inner
@kernel
def is_excessive(threshold: float, free: float, variance: float, squares: float) -> bool:
    """Tell whether the weighted sum of squares of what is left of a pixel is too much for noise."""
    return bool(squares - variance * free > threshold * np.sqrt(2.0 * free) * variance)


@inner
@kernel
def may_hold_another(threshold: float, free: float, variance: float, squares: float, score: float) -> bool:
    """Tell whether what is left of a pixel may hold a return: a high peak, or too much of everything.

    `free` are its degrees of freedom, `squares` its weighted sum of squares, and `score` its highest Re H in
    standard deviations of that for unit noise.
    """
    high = score > _TRIGGER * threshold * np.sqrt(max(variance, squares / max(free, 1.0)))
    return bool(high or is_excessive(threshold, free, variance, squares))
