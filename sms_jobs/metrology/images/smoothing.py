"""Smoothing of a texture before it is matched: what is too fine for the pixel grid is taken out."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats: TypeAlias = NDArray[np.float64]

LARGEST_SMOOTHING_PX = 0.7
"""Just below that of the binomial filter, (1, 2, 1) / 4, beyond which three pixels are too few."""


def smooth(image: NDArray[np.floating], sigma_px: float) -> Floats:
    """Smooth an image by a Gaussian of three pixels each way.

    Parameters
    ----------
    image
        (rows, columns).
    sigma_px
        Standard deviation, 0 to `LARGEST_SMOOTHING_PX`.

    Notes
    -----
    Along each axis the weights are (s^2 / 2, 1 - s^2, s^2 / 2), which have the variance s^2. They are the
    same at every pixel, also beside a region's edge: weights that depend on where an edge is would move
    the texture, and not in each state alike.
    """
    side = 0.5 * sigma_px**2
    weights = np.array([side, 1.0 - 2.0 * side, side])
    rows = ndimage.correlate1d(np.asarray(image, dtype=np.float64), weights, axis=0, mode="nearest")
    return np.asarray(ndimage.correlate1d(rows, weights, axis=1, mode="nearest"))


def noise_after_smoothing(smoothed: Floats, inside: NDArray[np.bool_], sigma_px: float) -> float:
    """Return the factor on the noise's variance with which matching a smoothed texture predicts its errors.

    Smoothing makes white noise weaker, and neighbours alike. A match weighs noise by the texture's slopes D
    and so has the error variance s^2 sum (g * D)^2 / (sum D^2)^2 with the filter g; a matcher that takes the
    noise for white is right with the variance s^2 sum (g * D)^2 / sum D^2.

    Parameters
    ----------
    smoothed, sigma_px
        What `smooth` returned, and the filter's standard deviation.
    inside
        (rows, columns), which pixels count.
    """
    before = after = 0.0
    for axis in range(2):
        slopes = np.gradient(smoothed, axis=axis)
        before += float(np.sum(slopes[inside] ** 2))
        after += float(np.sum(smooth(slopes, sigma_px)[inside] ** 2))
    return after / before if before > 0.0 else 1.0
