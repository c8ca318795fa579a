"""Smoothing of a texture before it is matched: what is too fine for the pixel grid is taken out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.images.masks import box_of, grown

LARGEST_SMOOTHING_PX = 0.7
"""Just below that of the binomial filter, (1, 2, 1) / 4, beyond which three pixels are too few."""


_RIM = 2  # px beyond a pixel that its filtered slope rests on


def _weights(sigma_px: float) -> Floats:
    side = 0.5 * sigma_px**2
    return np.array([side, 1.0 - 2.0 * side, side])


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
    import cv2

    weights, levels = _weights(sigma_px), np.asarray(image, dtype=np.float64)
    return np.asarray(cv2.sepFilter2D(levels, -1, weights, weights, borderType=cv2.BORDER_REPLICATE))


def noise_after_smoothing(smoothed: Floats, inside: Mask, sigma_px: float) -> float:
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
    part = grown(box_of(inside), _RIM)
    inside, before, after = inside[part], 0.0, 0.0
    for axis in range(2):
        slopes = _slopes(smoothed[part], axis)
        before += float(np.sum(slopes**2, where=inside))
        after += float(np.sum(smooth(slopes, sigma_px) ** 2, where=inside))
    return after / before if before > 0.0 else 1.0


def _slopes(image: Floats, axis: int) -> Floats:
    """Return half the differences between the pixels to either side; at the ends whole ones with the next."""
    slopes = np.empty(image.shape)
    along, found = np.moveaxis(image, axis, 0), np.moveaxis(slopes, axis, 0)
    np.subtract(along[2:], along[:-2], out=found[1:-1])
    found[1:-1] *= 0.5
    found[0], found[-1] = along[1] - along[0], along[-1] - along[-2]
    return slopes


def noise_of_pixels(sigma_px: float) -> float:
    """Return the factor by which smoothing changes the variance of white noise at a pixel."""
    return float(np.sum(_weights(sigma_px) ** 2) ** 2)


def noise_of_differences(sigma_px: float) -> float:
    """Return the variance of the mixed fourth difference of white noise of variance 1 after smoothing."""
    return float(np.sum(np.convolve(_weights(sigma_px), (1.0, -2.0, 1.0)) ** 2) ** 2)


def noise_in_windows(slope: Floats, sigma_px: float, radius: int) -> float:
    """Return the factor on the noise's variance that square windows of a smoothed texture see.

    It is that of `noise_after_smoothing`, s^2 sum (g * w D)^2 / sum (w D)^2, for windows w of 2 radius + 1
    pixels: at their borders the filter finds less to be alike.

    Parameters
    ----------
    slope
        (rows, columns), of the smoothed texture along one axis.
    sigma_px, radius
        Of the filter and of the windows, in px.
    """
    alike = np.convolve(_weights(sigma_px), _weights(sigma_px))
    shared = alike * (1.0 - np.abs(np.arange(-2, 3)) / (2 * radius + 1))
    rows, columns = slope.shape
    total = 0.0
    for j in range(3):
        for i in range(-2, 3):
            first = slope[j:, max(i, 0) : columns + min(i, 0)]
            second = slope[: rows - j, max(-i, 0) : columns + min(-i, 0)]
            twice = 2.0 if j else 1.0
            total += twice * shared[j + 2] * shared[i + 2] * float(np.einsum("ij,ij", first, second))
    whole = float(np.sum(slope**2))
    return total / whole if whole > 0.0 else 1.0
