"""Where an image shows a textured surface: what a camera alone can know of a specimen's outline."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.images.masks import distance_inside

WINDOW_RADIUS_PX: Final = 4
LEAST_CONTRAST: Final = 5.0
"""In standard deviations of the noise: with less, a match would be hardly worth having."""


def textured_pixels(
    texture: NDArray[np.floating],
    noise_variance: NDArray[np.floating] | float,
    coarsest_px: int,
    margin_px: int = 1,
) -> NDArray[np.bool_]:
    """Return which pixels lie on a textured surface.

    Parameters
    ----------
    texture
        (rows, columns), grey levels.
    noise_variance
        Of a pixel, in grey levels squared; one number, or (rows, columns).
    coarsest_px
        Plain places narrower than twice this belong to the surface: the speckle may be so coarse.
    margin_px
        By how much the outline is drawn in; a rim mixes with what lies behind.

    Notes
    -----
    A pixel is near texture if the grey levels of the window about it scatter by five times their noise. Such
    pixels reach beyond the surface by the window's radius, which is taken off after narrow gaps have been
    closed. The border of the image is no outline. Where light falls on a plain background, or a background
    has a texture of its own, a region of interest has to say what is meant.
    """
    import cv2

    size = 2 * WINDOW_RADIUS_PX + 1
    levels = np.asarray(texture, dtype=np.float64) - float(np.mean(texture))
    mean, square = (
        cv2.blur(values, (size, size), borderType=cv2.BORDER_REFLECT) for values in (levels, levels**2)
    )
    variance = square - mean**2
    near = variance > LEAST_CONTRAST**2 * np.asarray(noise_variance)
    if not near.any() or near.all():
        return np.asarray(near)
    # The image is continued as it ends, so that its border closes nothing and is no outline either.
    reach = 2 * coarsest_px + WINDOW_RADIUS_PX + margin_px
    closed = distance_inside(~np.pad(near, reach, mode="edge")) <= coarsest_px
    if closed.all():
        return np.ones_like(near)
    inwards = distance_inside(closed) > coarsest_px + WINDOW_RADIUS_PX + margin_px
    labels, _ = ndimage.label(inwards[reach:-reach, reach:-reach])
    area = np.bincount(labels.ravel())
    area[0] = 0
    return np.asarray((area >= coarsest_px**2)[labels])
