"""Pairs of speckle images whose every grey level is exact, whatever the displacement between them.

Speckle is a sum of Gaussian blobs that are known at every real point: the deformed image shows, at each
pixel, the reference point that is there, without any interpolation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import kernel
from sms_jobs.records.scene import CameraResponse, Speckle
from sms_jobs.virtual_rig.laser_speckle import LaserSpeckle, laser_speckle, rough_light
from sms_jobs.virtual_rig.light import SUBSAMPLES
from sms_jobs.virtual_rig.speckle import speckle_image

Pattern = Literal["blobs", "laser", "dots"]
"""Gaussian blobs; the laser speckle of thesis section 4.3.3; dots as the virtual rig prints and sees them."""

Displacement = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""From points of the reference (x, y) to their displacement (u, v), all in px."""

BLOB_PX = 1.8
"""Standard deviation of a blob: at half the sampling rate its amplitude is 10^-7."""

APERTURE = 1.0 / 16.0
"""Radius of the aperture of laser speckle, in cycles a pixel, r0 / N of the thesis: 8 px wide."""
DOT_PX = 10.0
"""Mean diameter of a printed dot: the autocorrelation is then 6.6 px wide, that of blobs 6.0 px."""

_REACH = 11  # px: a blob is exp(-18) there
_MARGIN = 30  # px round the image, for what moves into it


def speckle_pair(
    size: int | tuple[int, int], displacement: Displacement, seed: int, contrast: float = 400.0
) -> tuple[Floats, Floats]:
    """Return a reference image and the same speckle displaced, about a grey level of 2000.

    `size` is (rows, columns), or the side of a square, in px; `contrast` the standard deviation of both
    images. Slopes of the displacement have to be below 0.1 for the deformed image to be exact to 10^-7 of a
    blob, and below 0.3 for 10^-4.
    """
    shape = (size, size) if isinstance(size, int) else size
    x, y, height = blobs(shape, seed)
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    reference = stamped(shape, (x, y), height, (column, row), (x, y))
    u, v = displacement(x, y)
    deformed = stamped(shape, (x, y), height, seen_through(displacement, column, row), (x + u, y + v))
    scale = contrast / reference.std()
    return 2000.0 + scale * reference, 2000.0 + scale * deformed


def blobs(shape: tuple[int, int], seed: int) -> tuple[Floats, Floats, Floats]:
    """Return the places (x, y) and heights of the blobs of an image (rows, columns) and its surroundings."""
    rng = np.random.default_rng(seed)
    rows, columns = shape
    count = int((rows + 2 * _MARGIN) * (columns + 2 * _MARGIN) / 9.0)
    x, y = rng.uniform(-_MARGIN, np.array([[columns + _MARGIN], [rows + _MARGIN]]), (2, count))
    return x, y, rng.normal(size=count)


def seen_through(displacement: Displacement, column: Floats, row: Floats) -> tuple[Floats, Floats]:
    """Return which reference points (x, y) pixels of the deformed image show, by iteration."""
    a, b = column.copy(), row.copy()
    for _ in range(25):
        u, v = displacement(a, b)
        a, b = column - u, row - v
    return a, b


def affine_speckle(size: int, forward: Floats, seed: int, contrast: float = 400.0) -> Floats:
    """Return a square image of speckle that a (2, 2) matrix has carried about its middle, however far.

    With the unit matrix it is the image to compare with. Stretch and compression have to be below a third.
    """
    rng = np.random.default_rng(seed)
    margin = size // 2  # for the corners of what has turned
    count = int((size + 2 * margin) ** 2 / 9.0)
    middle = (size - 1) / 2.0
    blob = rng.uniform(-margin, size + margin, (2, count)) - middle
    height = rng.normal(size=count)
    place = np.mgrid[0:size, 0:size][::-1].reshape(2, -1) - middle
    shown = np.linalg.inv(forward) @ place
    moved = forward @ blob + middle
    grey = stamped((size, size), (blob[0], blob[1]), height, (shown[0], shown[1]), (moved[0], moved[1]))
    # The expected standard deviation of a field of blobs of unit variance, nine square pixels each.
    return np.asarray(2000.0 + contrast / np.sqrt(np.pi * BLOB_PX**2 / 9.0) * grey)


def stamped(
    shape: tuple[int, int],
    blob: tuple[Floats, Floats],
    height: Floats,
    shows: tuple[Floats, Floats],
    near: tuple[Floats, Floats],
) -> Floats:
    """Return the sum of blobs at the points that pixels (rows, columns) show; each is near a place there."""
    grey = np.zeros(shape)
    _stamp(grey, *blob, height, shows[0].reshape(shape), shows[1].reshape(shape), *near)
    return grey


@kernel
def _stamp(
    grey: Floats, x: Floats, y: Floats, height: Floats, shown_x: Floats, shown_y: Floats,
    near_x: Floats, near_y: Floats,
) -> None:  # fmt: skip
    """Add blobs at (x, y) to the pixels beside (near_x, near_y), by what these show."""
    rows, columns = grey.shape
    for k in range(height.size):
        column, row = int(np.rint(near_x[k])), int(np.rint(near_y[k]))
        for i in range(max(row - _REACH, 0), min(row + _REACH + 1, rows)):
            for j in range(max(column - _REACH, 0), min(column + _REACH + 1, columns)):
                dx, dy = shown_x[i, j] - x[k], shown_y[i, j] - y[k]
                grey[i, j] += height[k] * np.exp(-0.5 * (dx * dx + dy * dy) / BLOB_PX**2)


def shift(u: float, v: float) -> Displacement:
    """Return a translation."""
    return lambda x, y: (np.full_like(x, u), np.full_like(y, v))


def quadratic(size: int, curvature: float) -> Displacement:
    """Return a field about the image's middle with every second derivative `curvature`, in 1 / px."""
    middle = size / 2.0

    def field(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        a, b = x - middle, y - middle
        bend = 0.5 * curvature * (a * a + b * b)
        return bend + curvature * a * b, bend - curvature * a * b

    return field


def translated(
    pattern: Pattern, size: int, u: float, v: float, seed: int, contrast: float = 400.0
) -> tuple[Floats, Floats]:
    """Return a square reference image and the same pattern moved by (u, v) px, about a grey level of 2000.

    The values are exact: blobs and waves are known everywhere, and dots are drawn where they have moved to.
    Dots alone have edges, of which lens and pixels leave detail that is finer than pixels can show. Laser
    speckle that leaves the image enters it on the other side.
    """
    if pattern == "blobs":
        return speckle_pair(size, shift(u, v), seed, contrast)
    if pattern == "laser":
        light = rough_light(LaserSpeckle(APERTURE, seed), size, size)
        pair = laser_speckle(light), laser_speckle(light, u, v)
    else:
        pair = _seen_dots(size, 0.0, 0.0, seed), _seen_dots(size, u, v, seed)
    scale, mean = contrast / pair[0].std(), pair[0].mean()
    return 2000.0 + scale * (pair[0] - mean), 2000.0 + scale * (pair[1] - mean)


def _seen_dots(size: int, u: float, v: float, seed: int) -> Floats:
    """Return printed dots, moved by (u, v) px, as the virtual rig's camera sees them."""
    margin = 4  # px: the lens's blur ends there
    fine = SUBSAMPLES * (size + 2 * margin)
    printed = speckle_image(
        Speckle(DOT_PX, seed=seed), fine, fine, 1.0 / SUBSAMPLES, (-margin - u, -margin - v)
    )
    blurred = ndimage.gaussian_filter(printed, SUBSAMPLES * CameraResponse().blur_px)
    pixels = blurred.reshape(size + 2 * margin, SUBSAMPLES, -1, SUBSAMPLES).mean(axis=(1, 3))
    return np.asarray(pixels[margin:-margin, margin:-margin])


def halves(
    size: int, upper: float, lower: float, seed: int, pattern: Pattern = "blobs"
) -> tuple[Floats, Floats, NDArray[np.int32]]:
    """Return a pair whose halves move along x by `upper` and `lower` px, and the labels 1 and 2 of them."""
    labels = np.ones((size, size), np.int32)
    labels[size // 2 :] = 2
    reference, first = translated(pattern, size, upper, 0.0, seed)
    _, second = translated(pattern, size, lower, 0.0, seed)
    return reference, np.where(labels == 1, first, second), labels
