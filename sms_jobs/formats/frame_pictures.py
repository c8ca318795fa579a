"""Frames of a camera as small pictures, by which an operator sees light, focus and what saturates."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SATURATED = (255, 45, 45)


def frame_as_png(image: NDArray[Any], full_scale: float, most_px: int) -> bytes:
    """Return a frame as PNG: grey from 0 to full scale, red where any pixel beneath is saturated.

    Parameters
    ----------
    image
        (rows, columns), in grey levels.
    full_scale
        Grey level at which the camera saturates.
    most_px
        Longer side of the picture at most.
    """
    from PIL import Image

    step = -(-max(image.shape) // most_px)
    grey = np.clip(255.0 / full_scale * image[::step, ::step], 0.0, 255.0).astype(np.uint8)
    saturated = image >= full_scale
    for axis, length in enumerate(image.shape):
        saturated = np.logical_or.reduceat(saturated, np.arange(0, length, step), axis=axis)
    shown = np.repeat(grey[..., np.newaxis], 3, axis=2)
    shown[saturated] = _SATURATED
    out = io.BytesIO()
    Image.fromarray(shown).save(out, format="PNG", compress_level=1)
    return out.getvalue()
