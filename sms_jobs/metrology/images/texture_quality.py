"""How well a texture suits matching: how coarse its speckle is, and how exact a match can be."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.images.rounded_noise import variance_of_rounded

_SAME = 0.25  # grey levels by which the brightest pixels of two images of one brightness may differ
_FINE = 1.0 / 16.0  # of a grey level, for what is no whole number

_SLOPE_NOISE = 130.0 / 144.0
"""Variance of the slope filter (1, -8, 0, 8, -1) / 12 for white noise of variance 1."""


@dataclass(frozen=True)
class Texture:
    """What an image tells about itself.

    Attributes
    ----------
    speckle_px
        Full width at half maximum of the autocorrelation: about 0.6 of the diameter of round, densely
        printed speckles, which are each other's neighbours.
    low, high
        Grey levels that 1 % and 99 % of the pixels are below.
    contrast
        Standard deviation of the grey levels.
    saturated
        Part of the pixels at the brightest level that there is.
    slope_power
        (2, rows, columns), squared slopes along x and y, (count / px)^2, less the mean ones of the noise.
    noise
        Standard deviation of a pixel's noise, as it was given.
    """

    speckle_px: float
    low: float
    high: float
    contrast: float
    saturated: float
    slope_power: Floats
    noise: float


def noise_of_pair(first: NDArray[np.generic], second: NDArray[np.generic]) -> float:
    """Return the noise of a pixel from two images of one state, whatever their brightness.

    Notes
    -----
    The standard deviation of the difference over sqrt(2), see `variance_of_rounded`: a few pixels that
    changed do not count.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    ratio = _light_ratio(a, b)
    # Images of one brightness differ by whole grey levels, others by anything.
    step = 1.0 if abs(ratio - 1.0) * b.max() < _SAME else _FINE
    return sqrt(0.5 * variance_of_rounded(b * ratio - a, step))


def likeness_of_neighbours(first: NDArray[np.generic], second: NDArray[np.generic]) -> float:
    """Return how alike neighbouring pixels differ between two images, -1 to 1: about 0 for noise alone.

    Notes
    -----
    The autocorrelation of the difference one pixel along rows and columns, without its median and within five
    of its robust standard deviations, so that dust that came between does not count. A specimen that moved
    gives that of its texture's slopes, files with compression or interpolated colours that of their noise.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    difference = b * _light_ratio(a, b) - a
    difference -= np.median(difference)
    limit = 5.0 * 1.4826 * float(np.median(np.abs(difference))) + 1.0
    difference = np.clip(difference, -limit, limit)
    power = float(np.mean(difference**2))
    if power == 0.0:
        return 0.0
    along = (np.mean(difference[:, 1:] * difference[:, :-1]), np.mean(difference[1:] * difference[:-1]))
    return float(sum(along)) / (2.0 * power)


def _light_ratio(first: Floats, second: Floats) -> float:
    """Return the brightness of an image over that of another; 1 where one of them is black."""
    means = float(first.mean()), float(second.mean())
    return means[0] / means[1] if min(means) > 0.0 else 1.0


def examine_texture(image: NDArray[np.generic], noise: float, full_scale: float) -> Texture:
    """Return what an image, (rows, columns), tells; `noise` in grey levels, 0 where it is not known."""
    grey = np.asarray(image, dtype=np.float64)
    low, high = np.percentile(grey, (1.0, 99.0))
    power = np.stack([_slopes(grey, axis) ** 2 for axis in (1, 0)]) - _SLOPE_NOISE * noise**2
    return Texture(
        speckle_width(grey, noise),
        float(low),
        float(high),
        float(grey.std()),
        float(np.mean(grey >= full_scale)),
        power,
        noise,
    )


def _slopes(grey: Floats, axis: int) -> Floats:
    """Return slopes by five points, (f(-2) - 8 f(-1) + 8 f(1) - f(2)) / 12, without the image's rim."""
    rolled = {k: np.roll(grey, -k, axis) for k in (-2, -1, 1, 2)}
    found = (rolled[-2] - 8.0 * rolled[-1] + 8.0 * rolled[1] - rolled[2]) / 12.0
    return np.asarray(found[2:-2, 2:-2])


def speckle_width(grey: Floats, noise: float) -> float:
    """Return the full width at half maximum, in px, of the autocorrelation of an image.

    The mean along rows and columns, with the peak freed of the noise, which is correlated with nothing. NaN
    where it does not fall to a half within a quarter of the image.
    """
    level = grey - grey.mean()
    transformed = np.fft.rfft2(level)
    correlation = np.fft.irfft2(np.abs(transformed) ** 2, level.shape) / level.size
    reach = min(level.shape) // 4
    curve = 0.5 * (correlation[0, :reach] + correlation[:reach, 0])
    curve[0] -= min(noise**2, 0.5 * curve[0])
    below = np.flatnonzero(curve < 0.5 * curve[0])
    if len(below) == 0:
        return float("nan")
    k = int(below[0])
    part = (curve[k - 1] - 0.5 * curve[0]) / (curve[k - 1] - curve[k])
    return float(2.0 * (k - 1 + part))


def match_sigma(texture: Texture, subset_radius_px: int) -> float:
    """Return the expected standard deviation of a match, in px, both images being equally noisy.

    Notes
    -----
    sqrt(2) s / sqrt(sum I_x^2) over the (2 r + 1)^2 pixels of a subset (Pan et al. 2008, Eq. (12)), rms over
    all subsets of the image and both directions: a floor, to which a subset's misfit adds.
    """
    side = 2 * subset_radius_px + 1
    if min(texture.slope_power.shape[1:]) < side:
        return float("nan")
    sums = ndimage.uniform_filter(texture.slope_power, (0, side, side)) * side**2
    inner = sums[
        :, subset_radius_px : -subset_radius_px or None, subset_radius_px : -subset_radius_px or None
    ]
    if not (inner > 0.0).all():
        inner = inner[inner > 0.0]
    return sqrt(2.0 * texture.noise**2 * float(np.mean(1.0 / inner))) if inner.size else float("nan")


def gauge_sigma(texture: Texture, subset_radius_px: int, gauge_px: float) -> float:
    """Return the expected standard deviation of strain over a disc of diameter `gauge_px`, by matches alone.

    Notes
    -----
    A slope by least squares over a disc of radius R has the standard deviation 2 s / (sqrt(pi) R^2) where the
    error s is independent from pixel to pixel; that of a match is s (2 r + 1) per pixel, seen through its
    subset, by a fit to the exact sum of `deformation.strain.strain_errors` that is good to 10 %.
    """
    radius = 0.5 * gauge_px
    per_pixel = match_sigma(texture, subset_radius_px) * (2 * subset_radius_px + 1)
    q = subset_radius_px / radius
    return 2.0 * per_pixel / (sqrt(pi) * radius**2) / (1.0 + 0.25 * q + 1.27 * q**2)


def suggested_radius(texture: Texture) -> int:
    """Return the least subset radius that holds three speckles each way, and at least 7 px."""
    width = texture.speckle_px if np.isfinite(texture.speckle_px) else 3.0
    return max(7, ceil(1.5 * width / 0.6))
