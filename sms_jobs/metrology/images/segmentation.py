"""Discontinuities of a measured surface, and its continuous regions (thesis sections 4.2.2 and 4.2.3).

Two tests find discontinuities. The gradient of position over 2 p + 1 pixels, Eq. (3.8) and (3.9), is
compared with that of a surface as steep as can still be measured: a pixel of footprint f (mm on a surface
that faces the camera) sees f / cos(slope) of it. That alone would miss steps of a few footprints or, set
lower, cut off the sides of a top-hat, whose gradient is that of a step. So the second test asks how far
two neighbours are from meeting when each side is extended half way by its own slope: at any crease of two
smooth surfaces that is at most half the difference of the slopes and so never above the larger of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CREASE = 1.5  # slopes; 1 is the most that a crease can reach, the rest is for curved sides
_NOISE = 7.2  # sigmas: 4 of the gap's own sqrt(3.25), with slopes over three pixels
_DIRECTIONS = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])


@dataclass(frozen=True)
class ContinuousRegions:
    """Pieces of surface, by descending area, then by their centroid's column and row.

    Attributes
    ----------
    labels
        (rows, columns): 1, 2, ... in that order; 0 where there is none.
    areas
        (regions,) in px.
    centroids
        (regions, 2), x and y in px.
    """

    labels: NDArray[np.int32]
    areas: NDArray[np.int64]
    centroids: Floats


def pixel_footprint(xyz: Floats, intrinsics: Intrinsics, pose: Pose) -> Floats:
    """Return the size in mm of a pixel on a surface that faces the camera: depth over focal length.

    `xyz` is (3, rows, columns) in mm; the result (rows, columns), NaN where xyz is.
    """
    depth = np.tensordot(pose.matrix()[2], xyz, axes=1) + pose.translation[2]
    return np.asarray(depth * (2.0 / (intrinsics.fx + intrinsics.fy)))


@kernel
def _slope(
    xyz: Floats, valid: Mask, start: tuple[int, int, int, int], first: int, last: int, slope: Floats
) -> float:
    """Fit a line to the valid pixels at start + k direction, k = first .. last; return |d(xyz)/dk|.

    `start` is (row, column, row step, column step). NaN with fewer than two valid pixels.
    """
    row, column, down, right = start
    n, sum_k, sum_kk = 0.0, 0.0, 0.0
    for k in range(first, last + 1):
        r, c = row + k * down, column + k * right
        if 0 <= r < valid.shape[0] and 0 <= c < valid.shape[1] and valid[r, c]:
            n += 1.0
            sum_k += k
            sum_kk += k * k
    spread = n * sum_kk - sum_k * sum_k
    if n < 2.0:
        return np.nan
    slope[:] = 0.0
    for k in range(first, last + 1):
        r, c = row + k * down, column + k * right
        if 0 <= r < valid.shape[0] and 0 <= c < valid.shape[1] and valid[r, c]:
            for i in range(3):
                slope[i] += (n * k - sum_k) / spread * xyz[i, r, c]
    return sqrt(slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2])


@kernel
def _gradient_rows(
    xyz: Floats, valid: Mask, half_width: int, start: int, stop: int, gradient: Floats
) -> None:
    slope = np.empty(3)
    for row in range(start, stop):
        for column in range(valid.shape[1]):
            for axis in range(2):
                if valid[row, column]:
                    line = (row, column, axis, 1 - axis)
                    gradient[axis, row, column] = _slope(xyz, valid, line, -half_width, half_width, slope)


def surface_gradient(xyz: Floats, valid: Mask, half_width: int = 2, threads: int = 1) -> Floats:
    """Return the gradient magnitudes of position along the columns and along the rows.

    Parameters
    ----------
    xyz
        (3, rows, columns) in mm.
    valid
        (rows, columns); only these pixels are fitted.
    half_width
        p: each gradient is the slope of a line fitted to 2 p + 1 pixels.

    Returns
    -------
    (2, rows, columns) in mm/px: |dr/di| along a row and |dr/dj| down a column, thesis Eq. (3.8) and (3.9);
    NaN where the pixel is not valid or has no valid neighbour on the line.
    """
    gradient = np.full((2, *valid.shape), np.nan)
    in_row_blocks(
        lambda start, stop: _gradient_rows(xyz, valid, half_width, start, stop, gradient), len(valid), threads
    )
    return gradient


@kernel
def _mark_jumps(
    xyz: Floats,
    valid: Mask,
    sigma: Floats,
    limit: Floats,
    half_width: int,
    directions: NDArray[Any],
    jump: Mask,
) -> None:
    """Mark both pixels of every pair of neighbours that no crease explains."""
    before, after = np.zeros(3), np.zeros(3)
    rows, columns = valid.shape
    for row in range(rows):
        for column in range(columns):
            for d in range(len(directions)):
                down, right = directions[d]
                r, c = row + down, column + right
                if not (r < rows and 0 <= c < columns and valid[row, column] and valid[r, c]):
                    continue
                this, other = (row, column, down, right), (r, c, down, right)
                steep_before = _slope(xyz, valid, this, -half_width, 0, before)
                steep_after = _slope(xyz, valid, other, 0, half_width, after)
                one_sided = not (steep_before >= 0.0 and steep_after >= 0.0)
                square = 0.0
                for i in range(3):
                    gap = xyz[i, r, c] - xyz[i, row, column]
                    if not one_sided:
                        gap -= 0.5 * (before[i] + after[i])
                    square += gap * gap
                allowed = limit[row, column] * np.sqrt(float(down * down + right * right))
                if not one_sided:
                    allowed = min(allowed, _CREASE * max(steep_before, steep_after))
                if np.sqrt(square) > allowed + _NOISE * max(sigma[row, column], sigma[r, c]):
                    jump[row, column] = True
                    jump[r, c] = True


@kernel
def _grow(
    xyz: Floats, free: Mask, limit: Floats, labels: NDArray[np.int32], grown: NDArray[np.int32]
) -> None:
    """Give each free pixel the label of its nearest labelled neighbour in space, if that is within reach."""
    rows, columns = labels.shape
    for row in range(rows):
        for column in range(columns):
            grown[row, column] = labels[row, column]
            if labels[row, column] or not free[row, column]:
                continue
            nearest = np.inf
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    if labels[r, c] == 0:
                        continue
                    square = 0.0
                    for i in range(3):
                        square += (xyz[i, r, c] - xyz[i, row, column]) ** 2
                    if square < nearest and square < 2.0 * limit[row, column] ** 2:
                        nearest = square
                        grown[row, column] = labels[r, c]


def find_discontinuities(
    xyz: Floats,
    valid: Mask,
    sigma: Floats,
    footprint: Floats,
    *,
    half_width: int = 2,
    maximum_slope_rad: float = 1.4,
    threads: int = 1,
) -> Mask:
    """Return which valid pixels lie beside a discontinuity; parameters as of `label_regions`."""
    limit = footprint / cos(maximum_slope_rad)
    with np.errstate(invalid="ignore"):
        steep = (surface_gradient(xyz, valid, half_width, threads) >= limit).any(axis=0)
    jump = np.zeros_like(valid)
    _mark_jumps(xyz, valid, sigma, limit, half_width, _DIRECTIONS, jump)
    return np.asarray(steep | jump)


def label_regions(
    xyz: Floats,
    valid: Mask,
    sigma: Floats,
    footprint: Floats,
    *,
    minimum_area: int,
    half_width: int = 2,
    maximum_slope_rad: float = 1.4,
    threads: int = 1,
) -> ContinuousRegions:
    """Find the continuous pieces of a measured surface.

    Parameters
    ----------
    xyz
        (3, rows, columns) in mm.
    valid
        (rows, columns): which of them to trust, thesis Eq. (3.4).
    sigma
        (rows, columns) in mm: standard deviation of a position, e.g. the root of its covariance's trace.
    footprint
        (rows, columns) in mm, from `pixel_footprint`.
    minimum_area
        Smaller regions are dropped, in px.
    half_width
        p of the gradient, thesis section 4.2.2.
    maximum_slope_rad
        Steepest surface, measured from one that faces the camera, that is still continuous; 1.4 rad is
        80 degrees, where a pixel already covers six times its footprint.
    threads
        Number of threads; the result does not depend on it.

    Notes
    -----
    Pixels beside a discontinuity separate the 8-connected regions. They are then given back, from the
    outside in, to the region that is nearest to them in space, so that a region ends at its edge.
    """
    import cv2

    limit = footprint / cos(maximum_slope_rad)
    apart = find_discontinuities(
        xyz,
        valid,
        sigma,
        footprint,
        half_width=half_width,
        maximum_slope_rad=maximum_slope_rad,
        threads=threads,
    )
    _, pieces, table, _ = cv2.connectedComponentsWithStats(
        (valid & ~apart).astype(np.uint8), connectivity=8, ltype=cv2.CV_32S
    )
    large = table[:, cv2.CC_STAT_AREA] >= minimum_area
    large[0] = False
    labels: NDArray[np.int32] = np.where(large[pieces], pieces, 0).astype(np.int32)
    for _ in range(half_width + 1):
        grown = np.empty_like(labels)
        _grow(xyz, valid, limit, labels, grown)
        labels = grown
    return in_order(labels)


def in_order(labels: NDArray[np.int32]) -> ContinuousRegions:
    """Renumber regions by area, then centroid, so that they are found again in another state."""
    found, index = np.unique(labels, return_inverse=True)
    index = index.reshape(labels.shape)
    areas = np.bincount(index.reshape(-1), minlength=found.size)
    rows, columns = labels.shape
    x = np.bincount(index.reshape(-1), np.tile(np.arange(columns), rows), found.size) / areas
    y = np.bincount(index.reshape(-1), np.repeat(np.arange(rows), columns), found.size) / areas
    kept = np.flatnonzero(found > 0)
    order = kept[np.lexsort((y[kept], x[kept], -areas[kept]))]
    number = np.zeros(found.size, np.int32)
    number[order] = np.arange(1, order.size + 1)
    return ContinuousRegions(number[index], areas[order], np.stack([x[order], y[order]], axis=-1))
