"""Moments of a surface and its displacement over gauge discs, from the means of small squares of pixels."""

from __future__ import annotations

from typing import Final

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel, uncounted_summing_kernel
from sms_jobs.metrology.deformation.fields.cells import Cells

ROWS: Final = 18
"""Of what is told of a square: region, weight, position 3, displacement 3, covariance 6, normal 3, and
whether that is unknown."""
SUMS: Final = 31
"""Weight, and weighted: position 3, displacement 3, position by position 6, position by displacement 9,
covariance 6 and normal 3."""
COVARIANCE, NORMAL = 22, 28


def told_of_cells(cells: Cells) -> Floats:
    """Return what is known of each square, (18, rows, columns)."""
    unknown = ~np.any(cells.normal != 0.0, axis=0)
    first = np.stack([cells.labels.astype(np.float64), cells.weight])
    return np.concatenate(
        [first, cells.xyz, cells.displacement, cells.covariance, cells.normal, unknown[None]]
    )


@inner
@uncounted_kernel
def gather(told: Floats, top: int, bottom: int, left: int, right: int, near: Floats) -> int:
    """Copy the squares of rows top .. bottom and columns left .. right to the first columns of `near`.

    As far as the image goes. Return how many they are.
    """
    count = 0
    for j in range(max(top, 0), min(bottom, told.shape[1])):
        for i in range(max(left, 0), min(right, told.shape[2])):
            if told[0, j, i] == 0.0:
                continue
            for k in range(ROWS):
                near[k, count] = told[k, j, i]
            count += 1
    return count


@inner
@uncounted_summing_kernel
def disc_sums(
    near: Floats, count: int, label: float, centre: tuple[float, float, float], square: float,
    normal: tuple[float, float, float], least_cosine: float, sums: Floats,
) -> None:  # fmt: skip
    """Fill the weighted sums over the squares of a disc, positions about its centre.

    The disc has the squares of a region whose distance squared is at most `square`, but for those whose
    normal is known and has a cosine below `least_cosine` with `normal`. Each sum is a local number: only then
    are several squares added at a time.
    """
    x0, y0, z0 = centre
    nx0, ny0, nz0 = normal
    total = x_ = y_ = z_ = u_ = v_ = w_ = 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    xu = xv = xw = yu = yv = yw = zu = zv = zw = 0.0
    c0 = c1 = c2 = c3 = c4 = c5 = nx = ny = nz = 0.0
    for m in range(count):
        x, y, z = near[2, m] - x0, near[3, m] - y0, near[4, m] - z0
        cosine = near[14, m] * nx0 + near[15, m] * ny0 + near[16, m] * nz0
        inside = (near[0, m] == label) & (x * x + y * y + z * z <= square)
        inside &= (cosine >= least_cosine) | (near[17, m] != 0.0)
        weight = near[1, m] if inside else 0.0
        u, v, w = near[5, m], near[6, m], near[7, m]
        wx, wy, wz = weight * x, weight * y, weight * z
        total += weight
        x_ += wx
        y_ += wy
        z_ += wz
        u_ += weight * u
        v_ += weight * v
        w_ += weight * w
        xx += wx * x
        xy += wx * y
        xz += wx * z
        yy += wy * y
        yz += wy * z
        zz += wz * z
        xu += wx * u
        xv += wx * v
        xw += wx * w
        yu += wy * u
        yv += wy * v
        yw += wy * w
        zu += wz * u
        zv += wz * v
        zw += wz * w
        c0 += weight * near[8, m]
        c1 += weight * near[9, m]
        c2 += weight * near[10, m]
        c3 += weight * near[11, m]
        c4 += weight * near[12, m]
        c5 += weight * near[13, m]
        nx += weight * near[14, m]
        ny += weight * near[15, m]
        nz += weight * near[16, m]
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6] = total, x_, y_, z_, u_, v_, w_
    sums[7], sums[8], sums[9], sums[10], sums[11], sums[12] = xx, xy, xz, yy, yz, zz
    sums[13], sums[14], sums[15], sums[16], sums[17], sums[18] = xu, xv, xw, yu, yv, yw
    sums[19], sums[20], sums[21] = zu, zv, zw
    sums[22], sums[23], sums[24], sums[25], sums[26], sums[27] = c0, c1, c2, c3, c4, c5
    sums[28], sums[29], sums[30] = nx, ny, nz


@inner
@uncounted_kernel
def central_moments(sums: Floats, scatter: Floats, mixed: Floats) -> None:
    """Fill the moments about the means: of position with position, and of position with displacement."""
    total = sums[0]
    k = 7
    for a in range(3):
        for b in range(a, 3):
            scatter[a, b] = scatter[b, a] = sums[k] - sums[1 + a] * sums[1 + b] / total
            k += 1
        for b in range(3):
            mixed[a, b] = sums[13 + 3 * a + b] - sums[1 + a] * sums[4 + b] / total
