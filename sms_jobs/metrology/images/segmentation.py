"""Discontinuities of a measured surface, and its continuous regions (thesis sections 4.2.2 and 4.2.3).

Two tests find discontinuities. The gradient of position over 2 p + 1 pixels, Eq. (3.8) and (3.9), is
compared with that of a surface as steep as can still be measured: a pixel of footprint f (mm on a surface
that faces the camera) sees f / cos(slope) of it. That alone would miss steps of a few footprints or, set
lower, cut off the sides of a top-hat, whose gradient is that of a step. So the second test asks how far
two neighbours are from meeting when each side is extended half way by its own slope: at any crease of two
smooth surfaces that is at most half the difference of the slopes and so never above the larger of them.

The thesis's own tests, by the gradient alone and by the distance of neighbours, can be chosen instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sqrt
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inlined, inner, kernel, uncounted_kernel, variable
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.images.masks import box_of, grown

_CREASE = 1.5  # slopes; 1 is the most that a crease can reach, the rest is for curved sides
_NOISE = 7.2  # sigmas: 4 of the gap's own sqrt(3.25), with slopes over three pixels
_DIRECTIONS = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])

EdgeTest: TypeAlias = Literal["gap", "gradient", "distance"]


@dataclass(frozen=True)
class EdgeSettings:
    """How discontinuities of a surface are found.

    Attributes
    ----------
    test
        `gap`: both tests of this module; `gradient`: the first alone; `distance`: `distant_neighbours`.
    half_width
        p: slopes are those of lines through up to 2 p + 1 pixels. The test by distance has none.
    maximum_slope_rad
        Steepest surface, measured from one that faces the camera, that is still continuous; 1.4 rad is
        80 degrees, where a pixel already covers six times its footprint.
    distance
        In mm: of neighbours that are apart by the test by distance; None for what a pixel covers of the
        steepest surface.
    """

    test: EdgeTest = "gap"
    half_width: int = 2
    maximum_slope_rad: float = 1.4
    distance: float | None = None

    def limit(self, footprint: Floats) -> Floats:
        """Return the gradient, or the distance, in mm that is too large, where pixels have a footprint."""
        if self.test == "distance" and self.distance is not None:
            return np.full(footprint.shape, self.distance)
        return np.asarray(footprint / cos(self.maximum_slope_rad))

    @property
    def reach(self) -> int:
        """How many pixels beside a discontinuity are marked, on either side."""
        return 1 if self.test == "distance" else self.half_width


_USUAL = EdgeSettings()


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
    areas: Ints
    centroids: Floats


def pixel_footprint(xyz: Floats, intrinsics: Intrinsics, pose: Pose) -> Floats:
    """Return the size in mm of a pixel on a surface that faces the camera: depth over focal length.

    `xyz` is (3, rows, columns) in mm; the result (rows, columns), NaN where xyz is.
    """
    depth = np.tensordot(pose.matrix()[2], xyz, axes=1) + pose.translation[2]
    return np.asarray(depth * (2.0 / (intrinsics.fx + intrinsics.fy)))


@inner
@uncounted_kernel
def _slope(
    xyz: Floats, valid: Mask, start: tuple[int, int, int, int], first: int, last: int
) -> tuple[float, float, float]:
    """Fit a line to the valid pixels at start + k direction, k = first .. last; return d(xyz)/dk.

    `start` is (row, column, row step, column step), of which the pixel is valid. NaN without another one.
    """
    row, column, down, right = start
    x0, y0, z0 = xyz[0, row, column], xyz[1, row, column], xyz[2, row, column]
    n, sum_k, sum_kk = 0.0, 0.0, 0.0
    x, y, z, kx, ky, kz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(first, last + 1):
        r, c = row + k * down, column + k * right
        if 0 <= r < valid.shape[0] and 0 <= c < valid.shape[1] and valid[r, c]:
            n += 1.0
            sum_k += k
            sum_kk += k * k
            dx, dy, dz = xyz[0, r, c] - x0, xyz[1, r, c] - y0, xyz[2, r, c] - z0
            x += dx
            y += dy
            z += dz
            kx += k * dx
            ky += k * dy
            kz += k * dz
    per_spread = 1.0 / (n * sum_kk - sum_k * sum_k) if n > 1.0 else np.nan
    return (
        (n * kx - sum_k * x) * per_spread,
        (n * ky - sum_k * y) * per_spread,
        (n * kz - sum_k * z) * per_spread,
    )


@inlined
def _square(x: float, y: float, z: float) -> float:
    return x * x + y * y + z * z


@inner
@uncounted_kernel
def _slopes_of_five(xyz: Floats, valid: Mask, row: int, axis: int, slope: Floats, whole: Mask) -> None:
    """Fill (columns,) which pixels of a row have two valid ones on either side, and how steep they are."""
    rows, columns = valid.shape
    down, right = axis, 1 - axis
    whole[:] = False
    if row < 2 * down or row + 2 * down >= rows:
        return
    # Unsigned indices need no look at their sign, which would keep pixels from being done at a time.
    r0, r1, r2 = np.uint64(row - 2 * down), np.uint64(row - down), np.uint64(row)
    r3, r4 = np.uint64(row + down), np.uint64(row + 2 * down)
    for c in range(2 * right, columns - 2 * right):
        c0, c1, c2 = np.uint64(c - 2 * right), np.uint64(c - right), np.uint64(c)
        c3, c4 = np.uint64(c + right), np.uint64(c + 2 * right)
        square = 0.0
        for i in (np.uint64(0), np.uint64(1), np.uint64(2)):
            along = 0.2 * (xyz[i, r4, c4] - xyz[i, r0, c0]) + 0.1 * (xyz[i, r3, c3] - xyz[i, r1, c1])
            square += along * along
        all_five = valid[r0, c0] & valid[r1, c1] & valid[r2, c2] & valid[r3, c3] & valid[r4, c4]
        whole[c2] = all_five
        slope[c2] = sqrt(square) if all_five else np.nan


@kernel
def _gradient_rows(
    xyz: Floats, valid: Mask, half_width: int, start: int, stop: int, gradient: Floats
) -> None:
    whole = np.zeros(valid.shape[1], dtype=np.bool_)
    for row in range(start, stop):
        for axis in range(2):
            if half_width == 2:
                _slopes_of_five(xyz, valid, row, axis, gradient[axis, row], whole)
            for column in range(valid.shape[1]):
                if valid[row, column] and not whole[column]:
                    x, y, z = _slope(xyz, valid, (row, column, axis, 1 - axis), -half_width, half_width)
                    gradient[axis, row, column] = sqrt(_square(x, y, z))


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


@inner
@uncounted_kernel
def _look_closer(
    xyz: Floats, valid: Mask, sigma: Floats, limit: Floats, row: int, down: int, right: int, closer: Mask
) -> None:
    """Fill `closer` (columns,): which pixels of a row `_mark_jumps` has to look at with their neighbours.

    Not at those that three valid pixels on either side tell to be continuous: of three the one in the middle
    has no say in a slope, so that several pairs are told at a time.
    """
    rows, columns = valid.shape
    closer[:] = True
    if row < 2 * down or row + 3 * down >= rows:
        return
    step = sqrt(float(down * down + right * right))
    # Unsigned indices need no look at their sign, which would keep pairs from being told at a time.
    r0, r1, r2 = np.uint64(row - 2 * down), np.uint64(row - down), np.uint64(row)
    r3, r4, r5 = np.uint64(row + down), np.uint64(row + 2 * down), np.uint64(row + 3 * down)
    for c in range(max(2 * right, -3 * right, 0), columns - max(3 * right, -2 * right, 0)):
        c0, c1, c2 = np.uint64(c - 2 * right), np.uint64(c - right), np.uint64(c)
        c3, c4, c5 = np.uint64(c + right), np.uint64(c + 2 * right), np.uint64(c + 3 * right)
        before, after, gaps = 0.0, 0.0, 0.0
        for i in (np.uint64(0), np.uint64(1), np.uint64(2)):
            slope = 0.5 * (xyz[i, r2, c2] - xyz[i, r0, c0])
            beyond = 0.5 * (xyz[i, r5, c5] - xyz[i, r3, c3])
            gap = xyz[i, r3, c3] - xyz[i, r2, c2] - 0.5 * (slope + beyond)
            before += slope * slope
            after += beyond * beyond
            gaps += gap * gap
        allowed = min(limit[r2, c2] * step, _CREASE * sqrt(max(before, after)))
        allowed += _NOISE * max(sigma[r2, c2], sigma[r3, c3])
        whole = valid[r0, c0] & valid[r1, c1] & valid[r2, c2] & valid[r3, c3] & valid[r4, c4] & valid[r5, c5]
        closer[c2] = not (whole & (gaps <= allowed * allowed))


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
    rows, columns = valid.shape
    closer, here = np.ones(columns, dtype=np.bool_), variable(0)
    for d in range(len(directions)):
        down, right = directions[d, 0], directions[d, 1]
        step = sqrt(float(down * down + right * right))
        for row in range(rows - down):
            if half_width == 2:
                _look_closer(xyz, valid, sigma, limit, row, down, right, closer)
            for column in range(max(-right, 0), columns - max(right, 0)):
                r, c = row + down, column + right
                if not (closer[column] and valid[row, column] and valid[r, c]):
                    continue
                gap_x = xyz[0, r, c] - xyz[0, row, column]
                gap_y = xyz[1, r, c] - xyz[1, row, column]
                gap_z = xyz[2, r, c] - xyz[2, row, column]
                allowed = limit[row, column] * step
                x, y, z = _slope(xyz, valid, (row, column, down, right), -half_width, here)
                after_x, after_y, after_z = _slope(xyz, valid, (r, c, down, right), here, half_width)
                if np.isfinite(x) and np.isfinite(after_x):
                    steeper = max(_square(x, y, z), _square(after_x, after_y, after_z))
                    allowed = min(allowed, _CREASE * sqrt(steeper))
                    gap_x -= 0.5 * (x + after_x)
                    gap_y -= 0.5 * (y + after_y)
                    gap_z -= 0.5 * (z + after_z)
                allowed += _NOISE * max(sigma[row, column], sigma[r, c])
                if _square(gap_x, gap_y, gap_z) > allowed * allowed:
                    jump[row, column] = True
                    jump[r, c] = True


@uncounted_kernel
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


def distant_neighbours(xyz: Floats, valid: Mask, limit: Floats) -> Mask:
    """Return which pixels have a neighbour along an axis at `limit` or more, thesis Eq. (3.5) and (3.6).

    `xyz` is (3, rows, columns) in mm, `valid` (rows, columns), of which both neighbours must be; `limit` is
    (rows, columns) in mm, that of the left or upper one. Both of such a pair are marked: the thesis's
    condition alone, for the right or lower one, would leave regions connected across a diagonal.
    """
    apart = np.zeros_like(valid)
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])):
        step = xyz[:, *second] - xyz[:, *first]
        with np.errstate(invalid="ignore"):
            far = valid[first] & valid[second] & (np.sqrt(np.sum(step**2, axis=0)) >= limit[first])
        apart[first] |= far
        apart[second] |= far
    return apart


def find_discontinuities(
    xyz: Floats,
    valid: Mask,
    sigma: Floats,
    footprint: Floats,
    *,
    edges: EdgeSettings = _USUAL,
    threads: int = 1,
) -> Mask:
    """Return which valid pixels lie beside a discontinuity; parameters as of `label_regions`."""
    limit = edges.limit(footprint)
    if edges.test == "distance":
        return distant_neighbours(xyz, valid, limit)
    with np.errstate(invalid="ignore"):
        steep = (surface_gradient(xyz, valid, edges.half_width, threads) >= limit).any(axis=0)
    if edges.test == "gradient":
        return np.asarray(steep)
    jump = np.zeros_like(valid)
    _mark_jumps(xyz, valid, sigma, limit, edges.half_width, _DIRECTIONS, jump)
    return np.asarray(steep | jump)


def label_regions(
    xyz: Floats,
    valid: Mask,
    sigma: Floats,
    footprint: Floats,
    *,
    minimum_area: int,
    edges: EdgeSettings = _USUAL,
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
    edges
        How discontinuities are found.
    threads
        Number of threads; the result does not depend on it.

    Notes
    -----
    Pixels beside a discontinuity separate the 8-connected regions. They are then given back, from the
    outside in, to the region that is nearest to them in space, so that a region ends at its edge.
    """
    import cv2

    whole = np.zeros(valid.shape, dtype=np.int32)
    part = grown(box_of(valid), edges.half_width + 1)  # nobody looks further
    xyz, valid = np.ascontiguousarray(xyz[:, *part]), np.ascontiguousarray(valid[part])
    sigma, footprint = (np.ascontiguousarray(one[part]) for one in (sigma, footprint))
    limit = edges.limit(footprint)
    apart = find_discontinuities(xyz, valid, sigma, footprint, edges=edges, threads=threads)
    _, pieces, table, _ = cv2.connectedComponentsWithStats(
        (valid & ~apart).astype(np.uint8), connectivity=8, ltype=cv2.CV_32S
    )
    large = table[:, cv2.CC_STAT_AREA] >= minimum_area
    large[0] = False
    labels: NDArray[np.int32] = np.where(large[pieces], pieces, 0).astype(np.int32)
    for _ in range(edges.reach + 1):
        given_back = np.empty_like(labels)
        _grow(xyz, valid, limit, labels, given_back)
        labels = given_back
    whole[part] = labels
    return in_order(whole)


def in_order(labels: NDArray[np.int32]) -> ContinuousRegions:
    """Renumber regions by area, then centroid, so that they are found again in another state."""
    part = box_of(labels > 0)
    flat = labels[part].reshape(-1)
    areas = np.bincount(flat, minlength=1)
    down, right = np.ogrid[part]
    sums = [np.bincount(flat, np.broadcast_to(one, labels[part].shape).reshape(-1)) for one in (right, down)]
    kept = 1 + np.flatnonzero(areas[1:])
    x, y = (one[kept] / areas[kept] for one in sums)
    order = np.lexsort((y, x, -areas[kept]))
    number = np.zeros(areas.size, np.int32)
    number[kept[order]] = np.arange(1, order.size + 1)
    return ContinuousRegions(number[labels], areas[kept[order]], np.stack([x[order], y[order]], axis=-1))
