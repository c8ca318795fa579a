"""How much a field has changed that was computed twice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SIGMAS = 2.0


@dataclass(frozen=True)
class Change:
    """A field after minus the same before, over the points where both have a value.

    Attributes
    ----------
    points, gained, lost
        How many have a value in both, after alone, and before alone.
    rms, median, largest
        Of the difference, in its unit: the median with its sign, the largest as a size; None without points.
    sigma
        Rms of its standard deviation; None where that is not known of any point.
    beyond
        Part of the points of known standard deviation that changed by more than twice that; None without.
    """

    points: int
    gained: int
    lost: int
    rms: float | None
    median: float | None
    largest: float | None
    sigma: float | None
    beyond: float | None


def sigma_of_difference(before: NDArray[Any], after: NDArray[Any]) -> NDArray[np.float64]:
    """Return the standard deviation of a difference from those of its parts, as if they were independent.

    Results of the same images share their noise: their difference varies less than this, so that what exceeds
    twice this has changed for sure, and what does not may have.
    """
    return np.hypot(np.asarray(before, np.float64), np.asarray(after, np.float64))


def change_of(
    before: NDArray[Any], after: NDArray[Any], sigma: NDArray[Any] | None
) -> tuple[Change, NDArray[np.float64]]:
    """Return in numbers how a field has changed, and its difference, NaN where either has no value.

    Parameters
    ----------
    before, after
        Of one shape; NaN where there is no value.
    sigma
        Standard deviation of the difference, of that shape; None where it is not known.
    """
    difference = np.asarray(after, np.float64) - np.asarray(before, np.float64)
    was, there = np.isfinite(before), np.isfinite(after)
    known = was & there
    values = difference[known]
    counts = (int(values.size), int(np.count_nonzero(there & ~was)), int(np.count_nonzero(was & ~there)))
    if not values.size:
        return Change(*counts, None, None, None, None, None), difference
    spread, beyond = None, None
    if sigma is not None:
        stated = np.asarray(sigma, np.float64)[known]
        judged = np.isfinite(stated)
        if judged.any():
            spread = float(np.sqrt(np.mean(stated[judged] ** 2)))
            beyond = float(np.mean(np.abs(values[judged]) > _SIGMAS * stated[judged]))
    numbers = (np.sqrt(np.mean(values**2)), np.median(values), np.abs(values).max())
    rms, median, largest = map(float, numbers)
    return Change(*counts, rms, median, largest, spread, beyond), difference
