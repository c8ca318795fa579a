"""The loops that spread matches to pixels: of each pixel the weighted sums over the matches within reach."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints, Labels
from sms_jobs.metrology.compilation import inner, kernel, uncounted_kernel, uncounted_summing_kernel

_LANES = 8  # matches that one instruction may take
_ROOM = 264  # matches: of a power of 2, all rows would want the same lines of a core's cache
_BEYOND = 1.0 + 1e-9
"""Squared distance, in those of the reach, from which on a match weighs nothing however it is rounded."""


@inner
@uncounted_summing_kernel
def _weighted_sums(
    near: Floats, count: int, pixel: tuple[int, int, int], place: tuple[float, float, float],
    scale: tuple[float, float], sums: Floats,
) -> None:  # fmt: skip
    """Fill the weighted sums over the matches near a pixel: of 1, dx, dy, u, v, u^2, v^2, both variances,
    and what of the two together is noise.

    `pixel` is its column, row and region, `place` where it lies in space, `scale` one over the square of a
    pixel's size there and half of one over that of the reach in px. Each match is a column of `near`, as
    `_gather` fills it, and each sum a local number: only then are several matches added at a time. Those
    beyond reach and of other regions weigh nothing.
    """
    per_footprint, per_reach = scale
    column, row, label = float(pixel[0]), float(pixel[1]), float(pixel[2])
    x, y, z = place
    total, off_x, off_y, u_sum, v_sum = 0.0, 0.0, 0.0, 0.0, 0.0
    u_squares, v_squares, u_noise, v_noise, of_images = 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(count):
        dx = column - near[0, m]
        dy = row - near[1, m]
        ax, ay, az = near[2, m] - x, near[3, m] - y, near[4, m] - z
        d2 = per_reach * (dx * dx + dy * dy + per_footprint * (ax * ax + ay * ay + az * az))
        weight = (1.0 - d2) * (1.0 - d2) * near[5, m]
        # Written so that NaN is beyond reach.
        w = weight if (d2 < 1.0) & (near[6, m] == label) else 0.0
        xx, xy, yy = 0.5 * dx * dx, dx * dy, 0.5 * dy * dy
        u = near[9, m] + near[10, m] * dx + near[11, m] * dy
        v = near[12, m] + near[13, m] * dx + near[14, m] * dy
        u += near[15, m] * xx + near[16, m] * xy + near[17, m] * yy
        v += near[18, m] * xx + near[19, m] * xy + near[20, m] * yy
        total += w
        off_x += w * dx
        off_y += w * dy
        u_sum += w * u
        v_sum += w * v
        u_squares += w * u * u
        v_squares += w * v * v
        u_noise += w * near[7, m]
        v_noise += w * near[8, m]
        of_images += w * near[21, m]
    sums[0], sums[1], sums[2], sums[3], sums[4] = total, off_x, off_y, u_sum, v_sum
    sums[5], sums[6], sums[7], sums[8], sums[9] = u_squares, v_squares, u_noise, v_noise, of_images


@inner
@uncounted_kernel
def _box_of_cell(
    xyz: Floats, labels: Labels, rows: tuple[int, int], columns: tuple[int, int], box: Floats
) -> None:
    """Fill in the least and greatest numbers (5, 2) of a cell's labelled pixels: column, row, x, y, z."""
    box[0, 0], box[0, 1] = columns[0], columns[1] - 1
    box[1, 0], box[1, 1] = rows[0], rows[1] - 1
    box[2:, 0], box[2:, 1] = np.inf, -np.inf
    for r in range(rows[0], rows[1]):
        for c in range(columns[0], columns[1]):
            if labels[r, c] == 0:
                continue
            for i in range(3):
                if xyz[i, r, c] < box[2 + i, 0]:
                    box[2 + i, 0] = xyz[i, r, c]
                if xyz[i, r, c] > box[2 + i, 1]:
                    box[2 + i, 1] = xyz[i, r, c]


@inner
@uncounted_kernel
def _gather(
    matches: Floats, first: Ints, row: int, column: int, cells: int, box: Floats, scale: tuple[float, float],
    chosen: Ints, near: Floats,
) -> int:  # fmt: skip
    """Copy the matches in cells about one to the first columns of `near`; return how many they are.

    Or, where `near` is too small, at most how many. What is beyond reach of all of the cell's pixels, whose
    `box` is that of `_box_of_cell` and `scale` of `_weighted_sums`, is left out.
    """
    left, right = max(column - cells, 0), min(column + cells + 1, first.shape[1] - 1)
    top, bottom = max(row - cells, 0), min(row + cells + 1, first.shape[0])
    count = 0
    for j in range(top, bottom):
        count += first[j, right] - first[j, left]
    if count + _LANES > near.shape[1]:
        return count + _LANES
    count = 0
    for j in range(top, bottom):
        for m in range(first[j, left], first[j, right]):
            in_image, in_space = 0.0, 0.0
            for i in range(5):
                off = max(box[i, 0] - matches[m, i], matches[m, i] - box[i, 1], 0.0)
                if i < 2:
                    in_image += off * off
                else:
                    in_space += off * off
            # Written so that NaN, which weighs nothing, is left in, and what rounding may bring within reach.
            if scale[1] * (in_image + scale[0] * in_space) > _BEYOND:
                continue
            chosen[count] = m
            count += 1
    whole = -(-count // _LANES) * _LANES if count else 0
    for k in range(count, whole):
        chosen[k] = chosen[count - 1]
    for i in range(matches.shape[1]):
        for k in range(whole):
            near[i, k] = matches[chosen[k], i]
    for k in range(count, whole):
        near[6, k] = -1.0  # a region that no pixel has: these only fill the last instruction
    return whole


@kernel
def blend_rows(
    start: int, stop: int, xyz: Floats, labels: Labels, footprint: float, side: int, first: Ints,
    matches: Floats, reach: float,
    value: Floats, variance: Floats, scatter: Floats, images_part: Floats, aside: Floats,
) -> None:  # fmt: skip
    """Add up matches for `blend_matches`, of rows start .. stop.

    Matches are sorted into square cells of `side`: those of cells (j, i) to (j, m) are `first[j, i]` up to
    `first[j, m + 1]`. Each is a row: x, y, where it lies in space, one over the sum of its variances, its
    region, both variances, 12 numbers of its warp, and what of the sum of its variances is noise. `variance`
    and `scatter` (2, rows, columns) become the weighted means of the matches' own variances, and of the
    squares by which they differ about the pixel; `images_part` the part of the former that is noise, and
    `aside` how far their middle is from the pixel, in those of the reach.
    """
    cells = int(np.ceil(reach / side))
    scale = (1.0 / footprint**2, 0.5 / reach**2)
    near, chosen = np.empty((matches.shape[1], _ROOM)), np.empty(_ROOM, dtype=np.int64)
    box = np.empty((5, 2))
    sums = np.empty(10)
    for row in range(start // side, (stop - 1) // side + 1):
        for column in range(first.shape[1] - 1):
            count = -1
            own_rows = (max(row * side, start), min((row + 1) * side, stop))
            own_columns = (column * side, min((column + 1) * side, labels.shape[1]))
            for r in range(own_rows[0], own_rows[1]):
                for c in range(own_columns[0], own_columns[1]):
                    images_part[r, c] = aside[r, c] = np.nan
                    for a in range(2):
                        value[a, r, c] = variance[a, r, c] = scatter[a, r, c] = np.nan
                    if labels[r, c] == 0:
                        continue
                    if count < 0:
                        _box_of_cell(xyz, labels, own_rows, own_columns, box)
                        count = _gather(matches, first, row, column, cells, box, scale, chosen, near)
                        if count > near.shape[1]:
                            near = np.empty((matches.shape[1], 2 * count + _LANES))
                            chosen = np.empty(near.shape[1], dtype=np.int64)
                            count = _gather(matches, first, row, column, cells, box, scale, chosen, near)
                    place = (xyz[0, r, c], xyz[1, r, c], xyz[2, r, c])
                    _weighted_sums(near, count, (c, r, labels[r, c]), place, scale, sums)
                    total = sums[0]
                    if not total > 0.0:
                        continue
                    aside[r, c] = np.sqrt(sums[1] * sums[1] + sums[2] * sums[2]) / (total * reach)
                    images_part[r, c] = sums[9] / (sums[7] + sums[8])
                    for a in range(2):
                        mean = sums[3 + a] / total
                        value[a, r, c] = mean
                        variance[a, r, c] = sums[7 + a] / total
                        scatter[a, r, c] = max(sums[5 + a] / total - mean * mean, 0.0)
