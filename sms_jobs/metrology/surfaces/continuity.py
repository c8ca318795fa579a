"""Where a measured surface is continuous, without a calibration at hand, and its small holes filled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Labels, Mask
from sms_jobs.metrology.images.segmentation import EdgeSettings, label_regions, surface_gradient

_QUADRATIC = 6  # coefficients
_RING = 3  # px


@dataclass(frozen=True)
class Filled:
    """A surface whose small holes have been filled.

    Attributes
    ----------
    xyz
        (3, rows, columns) in mm.
    labels
        (rows, columns), region of each pixel, those of filled holes included.
    filled
        (rows, columns), which pixels were made up.
    holes
        Number of holes that were filled.
    """

    xyz: Floats
    labels: Labels
    filled: Mask
    holes: int


def median_footprint(xyz: Floats, valid: Mask, threads: int = 1) -> float:
    """Return the size in mm of a pixel on a surface that faces the camera, from the points alone.

    The median over the valid pixels of the smaller of the distances to the neighbours along a row and down a
    column: a slope stretches one of them only, unless it is diagonal. NaN where no pixel has a neighbour.
    `xyz` is (3, rows, columns) in mm.
    """
    gradient = surface_gradient(xyz, valid, 1, threads)
    finite = np.isfinite(gradient).all(axis=0)
    return float(np.median(gradient[:, finite].min(axis=0))) if finite.any() else float("nan")


def continuous_labels(
    xyz: Floats,
    sigma: NDArray[np.floating] | None = None,
    *,
    minimum_area: int = 9,
    maximum_slope_rad: float = 1.4,
    threads: int = 1,
) -> Labels:
    """Return the continuous pieces of a measured surface, (rows, columns): 1, 2, ... by area, 0 for none.

    Parameters
    ----------
    xyz
        (3, rows, columns) in mm, NaN where there is no point.
    sigma
        (rows, columns) in mm: standard deviation of a position; none if not given.
    minimum_area
        Smaller pieces are dropped, in px.
    maximum_slope_rad
        Steepest surface, from one that faces the camera, that is still continuous.
    threads
        Number of threads; the result does not depend on it.

    Notes
    -----
    As `label_regions`, with the footprint of `median_footprint`.
    """
    valid: Mask = np.asarray(np.isfinite(xyz).all(axis=0))
    footprint = median_footprint(xyz, valid, threads)
    if not np.isfinite(footprint):
        return np.zeros(valid.shape, np.int32)
    spread = np.zeros(valid.shape) if sigma is None else np.nan_to_num(np.asarray(sigma, np.float64))
    return label_regions(
        xyz,
        valid,
        spread,
        np.full(valid.shape, footprint),
        minimum_area=minimum_area,
        edges=EdgeSettings(maximum_slope_rad=maximum_slope_rad),
        threads=threads,
    ).labels


def fill_small_holes(xyz: Floats, labels: Labels, largest_px: int) -> Filled:
    """Fill holes of up to `largest_px` pixels that lie inside one region, and say which pixels those are.

    Parameters
    ----------
    xyz
        (3, rows, columns) in mm.
    labels
        (rows, columns), region of each pixel; 0 is no surface.
    largest_px
        Largest area of a hole that is filled, in px; 0 fills none.

    Notes
    -----
    A hole is a 4-connected piece of pixels without a region that touches neither the edge of the image nor
    two regions. Its positions are a quadratic function of row and column, fitted to the pixels around it:
    exact for what is quadratic over the hole, and wrong by whatever the specimen does there else, so that
    filled pixels must stay marked as such. Raises `InvalidInput` for a negative area.
    """
    import cv2

    if largest_px < 0:
        raise InvalidInput(f"the largest hole to fill has 0 px or more, not {largest_px}")
    xyz, labels = xyz.copy(), labels.copy()
    filled = np.zeros(labels.shape, np.bool_)
    empty = (labels <= 0).astype(np.uint8)
    count, pieces, table, _ = cv2.connectedComponentsWithStats(empty, connectivity=4, ltype=cv2.CV_32S)
    holes = 0
    for piece in range(1, count):
        if table[piece, cv2.CC_STAT_AREA] <= largest_px:
            holes += _fill(xyz, labels, filled, np.asarray(pieces), piece, [int(v) for v in table[piece]])
    return Filled(xyz, labels, filled, holes)


def _fill(xyz: Floats, labels: Labels, filled: Mask, pieces: Labels, piece: int, box: list[int]) -> bool:
    """Fill one hole in place, if it is one; return whether it was filled."""
    import cv2

    rows, columns = labels.shape
    left, top, width, height = box[:4]
    if left == 0 or top == 0 or left + width == columns or top + height == rows:
        return False
    reach = max(_RING, max(width, height) // 2)
    some = np.s_[
        max(top - reach, 0) : min(top + height + reach, rows),
        max(left - reach, 0) : min(left + width + reach, columns),
    ]
    hole = pieces[some] == piece
    near = cv2.dilate(hole.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~hole
    around = np.unique(labels[some][near])
    region = int(around[-1])
    if len(around) != 1 or region <= 0:
        return False
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    ring = cv2.dilate(hole.astype(np.uint8), disc).astype(bool) & (labels[some] == region) & ~filled[some]
    if np.count_nonzero(ring) < 2 * _QUADRATIC:
        return False
    y, x = np.mgrid[: hole.shape[0], : hole.shape[1]] / float(max(hole.shape))
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    fitted, _, rank, _ = np.linalg.lstsq(terms[ring], xyz[(slice(None), *some)][:, ring].T, rcond=None)
    if rank < _QUADRATIC:
        return False
    xyz[(slice(None), *some)][:, hole] = (terms[hole] @ fitted).T
    labels[some][hole] = region
    filled[some][hole] = True
    return True
