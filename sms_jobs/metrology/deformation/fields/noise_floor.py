"""What a measurement says of a specimen that does not move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_POINTS = 100
"""Of fewer a standard deviation is known to worse than 7 %, were they independent."""


@dataclass(frozen=True)
class NoiseFloor:
    """Of one quantity of interest over one still pair, in its unit.

    Attributes
    ----------
    bias
        Mean over the points.
    noise
        Standard deviation about that mean.
    stated
        Root mean square of the standard deviations that were stated for the points.
    points
        How many there are.
    """

    bias: float
    noise: float
    stated: float
    points: int


def noise_floor(values: NDArray[np.floating], sigma: NDArray[np.floating]) -> NoiseFloor | None:
    """Return bias and noise of values that should all be 0, with any shape.

    Parameters
    ----------
    values
        NaN where there is none.
    sigma
        Their stated standard deviations, in the same shape.

    Returns
    -------
    None for fewer than `LEAST_POINTS`.

    Notes
    -----
    The mean of the quantity over images of a specimen at rest, and its spatial standard deviation: after the
    iDICs Good Practices Guide for Digital Image Correlation (2018).
    """
    known = np.isfinite(values) & np.isfinite(sigma)
    found = np.asarray(values[known], dtype=np.float64)
    if found.size < LEAST_POINTS:
        return None
    stated = np.sqrt(np.mean(np.asarray(sigma[known], dtype=np.float64) ** 2))
    return NoiseFloor(float(found.mean()), float(found.std(ddof=1)), float(stated), found.size)
