"""Where an image shows a textured surface: what a camera alone can know of a specimen's outline."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.images.masks import distance_inside

WINDOW_RADIUS_PX: Final = 4
LEAST_CONTRAST: Final = 5.0
"""In standard deviations of the noise: with less, a match would be hardly worth having."""
_LEAST_PART: Final = 0.375
"""Of the standard deviation that the texture about it has: less is no part of it, whatever the noise."""
_OUTLINE_PX: Final = 4 * WINDOW_RADIUS_PX + 1
"""This far inside what is near texture a window may still see an outline, if a lens has smeared it."""
_NARROW: Final = 5
"""Blocks: what is narrower is a mark on a texture, or an edge, and no other texture is held against it."""
_REACH: Final = 4
"""Blocks by which a texture reaches beyond itself: more than a gap that is closed."""


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
    A pixel is near texture if the grey levels of the window about it scatter by five times their noise, and
    by three eighths of what is usual about it: a reflection, what a lossy file adds, and a rim that is
    smeared scatter by less (ADR 122). Such pixels reach beyond the surface by the window's radius, which is
    taken off after narrow gaps have been closed. The border of the image is no outline. Where light falls on
    a plain background, or a background has a texture as strong as the surface's, a region of interest has to
    say what is meant.
    """
    levels = np.asarray(texture, dtype=np.float64) - float(np.mean(texture))
    variance = _means(levels**2, WINDOW_RADIUS_PX) - _means(levels, WINDOW_RADIUS_PX) ** 2
    near = variance > LEAST_CONTRAST**2 * np.asarray(noise_variance)
    least = _LEAST_PART**2 * _usual(variance, near, coarsest_px)
    # Single windows may happen to show twice as much as others: farther off, several have to.
    near &= np.minimum(variance, _means(variance, coarsest_px // 2)) >= least
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


def _means(values: Floats, radius: int) -> Floats:
    """Return the means over squares about each pixel; the image is reflected at its border."""
    import cv2

    size = 2 * radius + 1
    return np.asarray(cv2.blur(values, (size, size), borderType=cv2.BORDER_REFLECT))


def _usual(variance: Floats, near: Mask, coarsest_px: int) -> Floats:
    """Return the variance of the texture about each pixel, (rows, columns); 0 where there is none.

    That is the largest of the means over the blocks about it. Means that fewer than five blocks side by side
    have count as those beside them: a mark has more contrast than the texture that it is on. So has the step
    at an outline: pixels whose windows may see one are left out.
    """
    inner = _drawn_in(near, coarsest_px, _OUTLINE_PX)
    side = coarsest_px + 2
    number, total = _sums(inner.astype(np.float64), side), _sums(np.where(inner, variance, 0.0), side)
    mean = np.where(number > 0.0, total / np.maximum(number, 1.0), np.inf)
    least = ndimage.minimum_filter(mean, _NARROW, mode="constant", cval=np.inf)
    least[np.isinf(least)] = 0.0
    usual = ndimage.maximum_filter(least, _NARROW + 2 * _REACH, mode="constant")
    rows, columns = variance.shape
    return np.asarray(usual.repeat(side, axis=0)[:rows].repeat(side, axis=1)[:, :columns])


def _drawn_in(near: Mask, gap_px: int, by_px: int) -> Mask:
    """Return which pixels lie so far inside what is near texture, gaps closed; its corners are square."""
    import cv2

    wide, narrow = (np.ones((2 * one + 1, 2 * one + 1), np.uint8) for one in (gap_px, gap_px + by_px))
    return np.asarray(cv2.erode(cv2.dilate(near.astype(np.uint8), wide), narrow), dtype=np.bool_)


def _sums(values: Floats, side: int) -> Floats:
    """Return the sums over square blocks, of which the last ones of rows and columns may be cut."""
    rows, columns = (np.arange(0, size, side) for size in values.shape)
    return np.asarray(np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1))
