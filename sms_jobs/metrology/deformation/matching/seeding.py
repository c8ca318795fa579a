"""First guesses of the image displacement, to a pixel, by masked cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks

_LEAST_OVERLAP = 0.5  # part of a template's pixels that must meet the searched image
_NARROW = 48  # px: a range that is searched at once
_COARSEST = 8  # px of the image in a pixel of the coarsest level
_SURE = 0.5  # correlation from which on what was found from coarse to fine is taken
_LEAST_PIXELS = 100  # of a template of a coarse level, and of one that may be found again
_TURN = np.pi / 12.0  # rad between the rotations that are tried: half of it blurs a small template little
_REPEATED = 0.8  # correlation with another place from which on a texture is taken to repeat itself
_SURE_SMALL = 0.65  # correlation from which on what a small template found is taken: chance alone has less


@dataclass(frozen=True)
class SearchSettings:
    """Where seeds are searched.

    Attributes
    ----------
    range_x, range_y
        Largest displacement looked for along the columns and the rows, in px. Beyond 48 px the search goes
        from coarse to fine.
    template_radius
        Half the side of the sub-images, in px.
    spacing
        Between seeds, in px; there is one for every region in every square of this side.
    range_rotation
        Largest rotation in the image that is looked for where no shift fits, in rad.
    """

    range_x: int = 40
    range_y: int = 40
    template_radius: int = 20
    spacing: int = 64
    range_rotation: float = 0.0


def masked_correlation(
    template: NDArray[np.floating], template_mask: Mask, image: NDArray[np.floating], image_mask: Mask
) -> Singles:
    """Return the zero-normalised cross-correlation of the masked pixels at every lag.

    Parameters
    ----------
    template, image
        (h, w) and (H, W) with H >= h and W >= w, in grey levels.
    template_mask, image_mask
        True for the pixels that count.

    Returns
    -------
    (H - h + 1, W - w + 1): element (j, i) is the correlation of the template with the part of the image
    whose first pixel is (j, i), over the pixels that count in both, -1 .. 1; -1 where fewer than half of
    the template's pixels meet the image's.

    Notes
    -----
    Thesis Eq. (3.10)-(3.13), normalised for the mask as in Padfield 2012, Eq. (8)-(20). Sums are
    made in the Fourier domain where the template is large.
    """
    import cv2

    def correlate(a: Singles, b: Singles) -> Singles:
        return np.asarray(cv2.matchTemplate(b, a, cv2.TM_CCORR), dtype=np.float32)

    # Means are removed first: in single precision the differences below would lose small contrasts.
    m1 = template_mask.astype(np.float32)
    m2 = image_mask.astype(np.float32)
    count1 = max(float(m1.sum()), 1.0)
    f = np.where(template_mask, template - np.sum(template * m1) / count1, 0.0).astype(np.float32)
    g = np.where(image_mask, image - np.sum(image * m2) / max(float(m2.sum()), 1.0), 0.0).astype(np.float32)
    squares = f * f
    if image_mask.all():
        # Every lag has the whole template, whose mean is 0.
        overlap, sum_f, ff = (np.asarray(v, np.float32) for v in (count1, 0.0, np.sum(squares)))
    else:
        overlap = np.maximum(np.rint(correlate(m1, m2)), 1.0)  # a number of pixels
        sum_f, ff = correlate(f, m2), correlate(squares, m2)
    over_template = partial(_sums_over, m1.shape) if template_mask.all() else partial(correlate, m1)
    sum_g = over_template(g)
    var_f, var_g = ff - sum_f**2 / overlap, over_template(g * g) - sum_g**2 / overlap
    product = var_f * var_g
    met = overlap >= _LEAST_OVERLAP * count1
    # A patch without contrast has a variance of rounding errors alone, which must not be divided by.
    enough = met & (product > 1e-8 * float(np.sum(squares)) * float(np.sum(g * g)))
    correlation = correlate(f, g) - sum_f * sum_g / overlap
    return np.where(enough, correlation / np.sqrt(np.where(enough, product, 1.0)), np.float32(-1.0))


def _sums_over(shape: tuple[int, ...], values: Singles) -> Singles:
    """Return the sums over all rectangles (rows, columns) of a shape that lie within an image."""
    import cv2

    sums = cv2.boxFilter(values, -1, shape[::-1], normalize=False)
    inside = tuple(slice(n // 2, whole - (n - 1) // 2) for n, whole in zip(shape, values.shape, strict=True))
    return np.asarray(sums[inside])


def _patch(image: Floats, row: int, column: int, half_rows: int, half_columns: int) -> tuple[Floats, Mask]:
    """Return the part of an image about a pixel, zero beyond the border, and which of it is inside."""
    rows, columns = image.shape
    top, left = row - half_rows, column - half_columns
    bottom, right = row + half_rows + 1, column + half_columns + 1
    patch = np.zeros((bottom - top, right - left))
    inside = np.zeros(patch.shape, dtype=bool)
    source = np.s_[max(top, 0) : min(bottom, rows), max(left, 0) : min(right, columns)]
    target = np.s_[
        max(top, 0) - top : min(bottom, rows) - top, max(left, 0) - left : min(right, columns) - left
    ]
    patch[target] = image[source]
    inside[target] = True
    return patch, inside


def _factors(settings: SearchSettings) -> list[int]:
    """Return how many pixels make one, level by level from the coarsest."""
    factor = 1
    while max(settings.range_x, settings.range_y) > _NARROW * factor and factor < _COARSEST:
        factor *= 2
    return [2**k for k in range(factor.bit_length() - 1, -1, -1)]


def block_means(image: Floats, factor: int) -> Floats:
    """Return the means of squares of an image, less what is left over at its right and bottom."""
    import cv2

    rows, columns = (n // factor for n in image.shape)
    if not rows or not columns:
        return np.zeros((rows, columns))
    whole = image[: rows * factor, : columns * factor]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA))


@dataclass(frozen=True)
class _Level:
    """Both images and the labels, `factor` pixels in one."""

    factor: int
    first: Floats
    second: Floats
    labels: Floats

    def search(
        self, x: int, y: int, label: float, about: tuple[int, int], reach: tuple[int, int], half: int
    ) -> tuple[int, int, float]:
        """Return the displacement near `about` within `reach`, both (u, v) in the level's pixels; its score.

        The score is -1 where too little of the region is seen.
        """
        column, row = x // self.factor, y // self.factor
        template, inside = _patch(self.first, row, column, half, half)
        own, _ = _patch(self.labels, row, column, half, half)
        inside &= own == label
        if self.factor > 1 and np.count_nonzero(inside) < _LEAST_PIXELS:
            return 0, 0, -1.0
        u, v = about
        searched, measured = _patch(self.second, row + v, column + u, half + reach[1], half + reach[0])
        lagged = masked_correlation(template, inside, searched, measured)
        down, right = np.unravel_index(int(np.argmax(lagged)), lagged.shape)
        return u + int(right) - reach[0], v + int(down) - reach[1], float(lagged[down, right])


def _from_coarse_to_fine(
    levels: list[_Level], x: int, y: int, label: float, settings: SearchSettings
) -> tuple[int, int, float]:
    """Search the coarsest level that shows enough of the region, then two pixels about that on each finer.

    Where that ends in no good match, the finest level is searched over the whole range.
    """
    finest, half = levels[-1], settings.template_radius
    found, known = (0, 0, -1.0), False
    for level in levels:
        about, reach = (2 * found[0], 2 * found[1]), (2, 2)
        if not known:
            about = (0, 0)
            reach = (-(-settings.range_x // level.factor), -(-settings.range_y // level.factor))
        found = level.search(x, y, label, about, reach, half)
        known = known if level is finest else found[2] > 0.0
    if known and found[2] < _SURE:
        at_once = finest.search(x, y, label, (0, 0), (settings.range_x, settings.range_y), half)
        found = max(found, at_once, key=lambda one: one[2])
    return found


def seed_displacements(
    reference: NDArray[np.generic],
    deformed: NDArray[np.generic],
    labels: NDArray[np.int32],
    x: Ints,
    y: Ints,
    settings: SearchSettings,
    threads: int = 1,
) -> tuple[Floats, Floats, Floats]:
    """Find the displacement, to a pixel, of the sub-images about some points.

    Parameters
    ----------
    reference, deformed
        (rows, columns), in grey levels.
    labels
        (rows, columns), continuous regions of the reference; a sub-image holds its centre's region only.
    x, y
        (n,), pixels of the reference on a region.
    settings
        Size of the sub-images and how far they are searched.
    threads
        How many threads to use.

    Returns
    -------
    u, v
        (n,), in px.
    score
        (n,), correlation there; -1 where there is none.
    """
    first = np.asarray(reference, dtype=np.float64)
    second = np.asarray(deformed, dtype=np.float64)
    regions = labels.astype(np.float64)
    levels = [
        _Level(f, block_means(first, f), block_means(second, f), regions[f // 2 :: f, f // 2 :: f])
        if f > 1
        else _Level(1, first, second, regions)
        for f in _factors(settings)
    ]
    u, v, score = np.zeros(len(x)), np.zeros(len(x)), np.full(len(x), -1.0)

    def work(start: int, stop: int) -> None:
        for k in range(start, stop):
            label = regions[y[k], x[k]]
            u[k], v[k], score[k] = _from_coarse_to_fine(levels, int(x[k]), int(y[k]), label, settings)

    in_row_blocks(work, len(x), threads, block=8)
    return u, v, score


def repeats_itself(
    reference: NDArray[np.generic],
    labels: NDArray[np.int32],
    x: Ints,
    y: Ints,
    settings: SearchSettings,
    threads: int = 1,
) -> Mask:
    """Return whether the sub-images about points (n,) are found again within the range that is searched.

    As of `seed_displacements`; beyond 48 px nobody looks, and small pieces resemble others by chance. A place
    is another one if the correlation falls to half on every way to it.
    """
    image, regions = np.asarray(reference, dtype=np.float64), labels.astype(np.float64)
    half = settings.template_radius
    reach = (min(settings.range_y, _NARROW), min(settings.range_x, _NARROW))
    again = np.zeros(len(x), dtype=bool)

    def work(start: int, stop: int) -> None:
        for k in range(start, stop):
            row, column = int(y[k]), int(x[k])
            template, inside = _patch(image, row, column, half, half)
            own, _ = _patch(regions, row, column, half, half)
            inside &= own == regions[row, column]
            if np.count_nonzero(inside) < _LEAST_PIXELS:
                continue
            searched, measured = _patch(image, row, column, half + reach[0], half + reach[1])
            lagged = masked_correlation(template, inside, searched, measured)
            islands, _ = ndimage.label(lagged > 0.5)
            again[k] = bool((lagged[islands != islands[reach]] >= _REPEATED).any())

    in_row_blocks(work, len(x), threads, block=8)
    return again


def turned_patch(
    image: Floats, regions: Floats, x: int, y: int, half: int, angle: float
) -> tuple[Floats, Mask]:
    """Return the sub-image about a pixel as it looks turned by an angle, and which of it counts."""
    j, i = np.mgrid[-half : half + 1, -half : half + 1]
    c, s = np.cos(angle), np.sin(angle)
    place = np.stack([y - s * i + c * j, x + c * i + s * j])
    template = ndimage.map_coordinates(image, place, order=1, mode="nearest")
    label = ndimage.map_coordinates(regions, place, order=0, mode="constant", cval=-1.0)
    return np.asarray(template), np.asarray(label == regions[y, x])


def seed_warps(
    reference: NDArray[np.generic],
    deformed: NDArray[np.generic],
    labels: NDArray[np.int32],
    x: Ints,
    y: Ints,
    settings: SearchSettings,
    threads: int = 1,
) -> tuple[Floats, Floats]:
    """Guess the warps of sub-images that may have turned; parameters as of `seed_displacements`.

    Where no shift fits well, sub-images of half the size are tried, which bear more rotation and strain, as
    they are and turned by multiples of 15 degrees within the range.

    Returns
    -------
    warp
        (n, 6): u, du/dx, du/dy, v, dv/dx, dv/dy; the slopes are those of the rotation.
    score
        (n,), correlation there; -1 where there is none.
    """
    u, v, score = seed_displacements(reference, deformed, labels, x, y, settings, threads)
    warp = np.zeros((len(x), 6))
    warp[:, 0], warp[:, 3] = u, v
    first, second = (np.asarray(image, dtype=np.float64) for image in (reference, deformed))
    regions = labels.astype(np.float64)
    half = settings.template_radius // 2
    most = int(settings.range_rotation / _TURN + 1e-9)
    weak = np.flatnonzero(score < _SURE)

    def work(start: int, stop: int) -> None:
        for k in weak[start:stop]:
            searched, measured = _patch(
                second, int(y[k]), int(x[k]), half + settings.range_y, half + settings.range_x
            )
            best = max(float(score[k]), _SURE_SMALL)
            for turn in sorted(range(-most, most + 1), key=abs):
                template, inside = turned_patch(first, regions, int(x[k]), int(y[k]), half, turn * _TURN)
                if np.count_nonzero(inside) < _LEAST_PIXELS:
                    continue
                lagged = masked_correlation(template, inside, searched, measured)
                down, right = np.unravel_index(int(np.argmax(lagged)), lagged.shape)
                if lagged[down, right] > best:
                    best = score[k] = float(lagged[down, right])
                    c, s = np.cos(turn * _TURN), np.sin(turn * _TURN)
                    warp[k] = (right - settings.range_x, c - 1.0, -s, down - settings.range_y, s, c - 1.0)

    in_row_blocks(work, len(weak), threads, block=8)
    return warp, score
