"""The texture of a measurement, filtered, and its noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.deformation.matching.correlation import Noise, Spots
from sms_jobs.metrology.images.smoothing import noise_after_smoothing, smooth
from sms_jobs.records.measurement import Measurement

_PIXEL_VARIANCE = 1.0 / 12.0
"""Of a pixel's own square, px^2: what blurs an image beside the filter; a lens's blur is not known."""


def spots_of(smoothing_px: float) -> Spots:
    """Return the variances in px^2 of the spots that two filtered images show of a point."""
    spot = smoothing_px**2 + _PIXEL_VARIANCE
    return spot, spot


def white_texture(
    measurement: Measurement, smoothing_px: float, of_interest: NDArray[np.bool_]
) -> tuple[NDArray[np.floating], Noise]:
    """Return the white frame, filtered, and its noise over the pixels of interest, (rows, columns)."""
    noise = Noise(measurement.read_noise**2, measurement.gain)
    return filtered(measurement.texture.astype(np.float64), noise, smoothing_px, of_interest)


def filtered(
    texture: NDArray[np.floating], noise: Noise, smoothing_px: float, of_interest: NDArray[np.bool_]
) -> tuple[NDArray[np.floating], Noise]:
    """Return a texture (rows, columns) after the filter, and what of its noise over some pixels is left."""
    smoothed = smooth(texture, smoothing_px)
    factor = noise_after_smoothing(smoothed, of_interest, smoothing_px)
    return smoothed, Noise(noise.floor * factor, noise.slope * factor)
