"""Which pixels to trust: thesis Eq. (3.1)-(3.4), and the ray gap; True where a test is failed.

A value that is NaN fails no test here: it was lost for a reason of its own.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from sms_jobs.metrology.arrays import Mask, Singles

Floating = NDArray[np.floating]


def high_phase_error(phase_error: Floating, limit: Floating | float) -> Mask:
    """Return where the phase error in rad reaches its limit, thesis Eq. (3.1)."""
    return np.asarray(phase_error >= limit)


def low_modulation(modulation: Floating, least: Floating | float) -> Mask:
    """Return where the modulation, in grey levels, is below its least value, thesis Eq. (3.2)."""
    return np.asarray(modulation < least)


def outside_box(xyz: Floating, low: tuple[float, float, float], high: tuple[float, float, float]) -> Mask:
    """Return where points (3, rows, columns) lie outside a box, corners in mm: thesis Eq. (3.3), all axes."""
    corner_low, corner_high = np.reshape(low, (3, 1, 1)), np.reshape(high, (3, 1, 1))
    return np.asarray(np.any((xyz < corner_low) | (xyz > corner_high), axis=0))


def large_ray_gap(
    ray_gap: Floating, ray_gap_sigma: Floating, calibration_sigma: Floating, sigmas: float
) -> Mask:
    """Return where the rays miss each other by more than noise and calibration explain.

    They may by `sigmas` standard deviations of both together, whose squares add; all lengths are in mm.
    """
    return np.asarray(np.abs(ray_gap) > sigmas * np.hypot(ray_gap_sigma, calibration_sigma))


def at_edge(valid: Mask, smallest_gap: int, within: Mask | None = None) -> Mask:
    """Return the valid pixels (rows, columns) that touch a gap in what is measured, or lie diagonally by it.

    The outermost pixels of a surface share their light with what lies beside it, a shadow or another
    surface, and may show either.

    Parameters
    ----------
    smallest_gap
        A gap of fewer connected pixels is not an edge: noise alone makes single pixels fail.
    within
        (rows, columns): pixels of which a gap alone is not an edge either, such as rims of dark speckles.
    """
    import cv2

    count, labels, statistics, _ = cv2.connectedComponentsWithStats((~valid).astype(np.uint8), connectivity=8)
    is_gap = statistics[:, cv2.CC_STAT_AREA] >= smallest_gap
    is_gap[0] = False  # the valid pixels themselves
    if within is not None:
        is_gap &= np.bincount(labels[~valid & ~within], minlength=count) > 0
    return np.asarray(valid & widened(is_gap[labels], 3))


def of_one_label(labels: NDArray[np.int32], side: int) -> Mask:
    """Return which pixels (rows, columns) have one label all over the square of a side in px about them.

    The border of the image ends no label.
    """
    import cv2

    square, values = np.ones((side, side), np.uint8), labels.astype(np.float32)
    return np.asarray(cv2.erode(values, square) == cv2.dilate(values, square))


def beside_another_label(labels: NDArray[np.int32]) -> Mask:
    """Return which labelled pixels (rows, columns) have another label, not 0, within two px."""
    import cv2

    if not labels.size:  # OpenCV takes no empty image
        return np.zeros(labels.shape, dtype=bool)
    square, values = np.ones((5, 5), np.uint8), labels.astype(np.float32)
    low = cv2.erode(np.where(labels > 0, values, np.float32(np.inf)), square)
    return np.asarray((labels > 0) & (cv2.dilate(values, square) > low))


def wide_gaps(labels: NDArray[np.int32], width: int) -> Mask:
    """Return which pixels without a label (rows, columns) lie in gaps of at least about a width in px."""
    import cv2

    # An opening by an even number of pixels would shift what it leaves.
    square = np.ones((width | 1, width | 1), np.uint8)
    return np.asarray(cv2.morphologyEx((labels == 0).astype(np.uint8), cv2.MORPH_OPEN, square) > 0)


def widened(mask: Mask, side: int) -> Mask:
    """Return which pixels have one of the mask's in the square of an odd side in px about them."""
    import cv2

    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def narrowed(mask: Mask, side: int, *, border_ends: bool = False) -> Mask:
    """Return which pixels have none but the mask's in the square of an odd side in px about them.

    `border_ends` says whether what lies beyond the image's border is none of the mask's.
    """
    import cv2

    square, image = np.ones((side, side), np.uint8), mask.astype(np.uint8)
    if border_ends:
        return np.asarray(cv2.erode(image, square, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)
    return np.asarray(cv2.erode(image, square) > 0)


def distance_inside(mask: Mask) -> Singles:
    """Return the distance of each of the mask's pixels from the nearest that is none, in px; 0 for others.

    The border of the image is none. The squares are whole numbers: rounding them takes away what depends on
    how many threads OpenCV has, which calls another library where it has one.
    """
    import cv2

    part = grown(box_of(mask), 1)  # no pixel beyond the ring about it is nearer than one of the ring
    inside = mask[part].astype(np.uint8)
    squares = np.square(cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
    found = np.zeros(mask.shape, dtype=np.float32)
    found[part] = np.sqrt(np.rint(squares))
    return found


def box_of(mask: Mask) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest box that holds all pixels (rows, columns) of a mask."""
    first, last = [], []
    for axis in (1, 0):
        some = np.flatnonzero(mask.any(axis=axis))
        first.append(int(some[0]) if len(some) else 0)
        last.append(int(some[-1]) + 1 if len(some) else 0)
    return slice(first[0], last[0]), slice(first[1], last[1])


def grown(box: tuple[slice, slice], margin: int) -> tuple[slice, slice]:
    """Return a box of rows and columns with a margin in px, as far as the image goes that it is cut from."""
    rows, columns = (slice(max(one.start - margin, 0), one.stop + margin) for one in box)
    return rows, columns


def alone(valid: Mask, reach: int = 1) -> Mask:
    """Return the valid pixels (rows, columns) that reach no other in their row, or none in their column."""
    has_beside, has_above = np.zeros_like(valid), np.zeros_like(valid)
    for step in range(1, reach + 1):
        has_beside[:, step:] |= valid[:, :-step]
        has_beside[:, :-step] |= valid[:, step:]
        has_above[step:] |= valid[:-step]
        has_above[:-step] |= valid[step:]
    return np.asarray(valid & ~(has_beside & has_above))


def phase_error_factor(fitted: int, kept: float) -> float:
    """Return how many phase standard deviations the phase error may reach so that `kept` of good pixels pass.

    With Gaussian noise, (n - 1) (phase error / sigma)^2 of n fitted densities has the chi-square
    distribution of n - 1 degrees of freedom. Infinite for one density, which leaves no residual.
    """
    return sqrt(chdtri(fitted - 1, 1.0 - kept) / (fitted - 1)) if fitted > 1 else float("inf")


def spots(where: Mask, most_px: int) -> Mask:
    """Return the pixels of a mask (rows, columns) whose piece is at most `most_px` wide and high."""
    import cv2

    _, labels, about, _ = cv2.connectedComponentsWithStats(where.astype(np.uint8), connectivity=8)
    small = (about[:, cv2.CC_STAT_WIDTH] <= most_px) & (about[:, cv2.CC_STAT_HEIGHT] <= most_px)
    small[0] = False  # the background
    return np.asarray(small[labels])
