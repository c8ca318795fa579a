"""What one image of a texture tells before anybody matches it: where it is lit, and stands out of noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Singles
from sms_jobs.metrology.images.texture_extent import LEAST_CONTRAST

BLOCK_PX: Final = 16
"""Side of the blocks that are looked at: three or four speckles of a usual size, less than a usual subset."""
_ACROSS: Final = 3
"""Blocks that have to stand out side by side, each way: an outline alone is one or two wide."""


@dataclass(frozen=True)
class ImageQuality:
    """How well the texture of an image can be matched.

    Attributes
    ----------
    lit_fraction
        Part of the image where grey levels scatter by `LEAST_CONTRAST` times their noise, or saturate.
    saturated_fraction
        Part of the pixels there that are saturated.
    contrast
        Median standard deviation of the grey levels there, less that of noise, as a fraction of full scale.
    contrast_to_noise
        The same in standard deviations of the noise.
    level
        Grey level that 99 % of all pixels are below, as a fraction of full scale.

    What is of the lit region is 0 where there is none.
    """

    lit_fraction: float
    saturated_fraction: float
    contrast: float
    contrast_to_noise: float
    level: float


def image_quality(
    image: NDArray[Any], full_scale: int, gain: float, read_noise: float, *, areas: bool
) -> ImageQuality:
    """Judge an image, (rows, columns), block by block.

    Parameters
    ----------
    full_scale
        Grey level at which the camera saturates.
    gain, read_noise
        Noise model in grey levels: variance = read_noise^2 + gain * level.
    areas
        Count only what stands out in areas, as speckle does, and not the outlines of something plain.
    """
    blocks = _blocks(image)
    saturated = (blocks >= full_scale).mean(axis=(1, 3))
    mean = blocks.mean(axis=(1, 3))
    noise = read_noise**2 + gain * mean
    variance = blocks.var(axis=(1, 3))
    lit = (variance > LEAST_CONTRAST**2 * noise) | (saturated > 0.5)
    if areas and min(lit.shape) >= _ACROSS:
        lit = ndimage.binary_opening(lit, np.ones((_ACROSS, _ACROSS), np.bool_))
    level = float(np.percentile(image, 99.0)) / full_scale
    if not lit.any():
        return ImageQuality(0.0, 0.0, 0.0, 0.0, level)
    signal = np.sqrt(np.maximum(variance - noise, 0.0))[lit]
    return ImageQuality(
        float(lit.mean()),
        float(saturated[lit].mean()),
        float(np.median(signal)) / full_scale,
        float(np.median(signal / np.sqrt(noise[lit]))),
        level,
    )


def _blocks(image: NDArray[Any]) -> Singles:
    """Return whole blocks, (block rows, pixel rows, block columns, pixel columns); one of a smaller image."""
    rows, columns = image.shape
    high, wide = min(BLOCK_PX, rows), min(BLOCK_PX, columns)
    down, across = rows // high, columns // wide
    cut = np.asarray(image[: down * high, : across * wide], np.float32)
    return cut.reshape(down, high, across, wide)
