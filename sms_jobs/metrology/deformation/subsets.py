"""The pixels of a subset that lie on its region, and the sums over them that matching needs."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel, summing_kernel

Floats: TypeAlias = NDArray[np.float64]
Labels: TypeAlias = NDArray[np.int32]
Ints: TypeAlias = NDArray[np.int64]

_RIM = 5  # px at an image's border where reflection bends its spline: the effect falls by 0.43 a pixel


@kernel
def inside(
    warp: Floats,
    cx: int,
    cy: int,
    left: int,
    right: int,
    top: int,
    bottom: int,
    rows: int,
    columns: int,
    reach: float,
) -> bool:
    """Return whether a box about (cx, cy) is warped into the image, or at most `reach` px over its border."""
    for x in (left, right):
        for y in (top, bottom):
            px = cx + x + warp[0] + warp[1] * x + warp[2] * y
            py = cy + y + warp[3] + warp[4] * x + warp[5] * y
            if not (px >= -reach and py >= -reach and px <= columns - 1 + reach and py <= rows - 1 + reach):
                return False
    return True


@kernel
def collect(
    reference: Floats,
    gradient_x: Floats,
    gradient_y: Floats,
    labels: Labels,
    cx: int,
    cy: int,
    radius: int,
    warp: Floats,
    dx: Floats,
    dy: Floats,
    f: Floats,
    gx: Floats,
    gy: Floats,
    box: Ints,
) -> int:
    """Fill a subset's offsets, grey levels and slopes and their bounding box; return its number of pixels.

    A pixel belongs if it lies on the centre's region and neither it nor its expected counterpart lies at the
    border of its image.
    """
    rows, columns = labels.shape
    label = labels[cy, cx]
    left = max(-radius, _RIM - cx)
    right = min(radius, columns - 1 - _RIM - cx)
    top = max(-radius, _RIM - cy)
    bottom = min(radius, rows - 1 - _RIM - cy)
    whole = inside(warp, cx, cy, left, right, top, bottom, rows, columns, -_RIM)
    box[:] = (right, left, bottom, top)
    count = 0
    for j in range(top, bottom + 1):
        row = np.uint64(cy + j)
        first = count
        for i in range(left, right + 1):
            column = np.uint64(cx + i)
            if labels[row, column] != label:
                continue
            if not whole and not inside(warp, cx, cy, i, i, j, j, rows, columns, -_RIM):
                continue
            dx[count] = i
            dy[count] = j
            f[count] = reference[row, column]
            gx[count] = gradient_x[row, column]
            gy[count] = gradient_y[row, column]
            count += 1
        if count > first:
            box[0] = min(box[0], int(dx[first]))
            box[1] = max(box[1], int(dx[count - 1]))
            box[2] = min(box[2], j)
            box[3] = j
    return count


@kernel
def _unpack_hessian(h: Floats, hessian: Floats) -> None:
    """Fill the symmetric 6 x 6 matrix from the sums of gx gx, gx gy and gy gy with 1, dx, dy, dx^2 ..."""
    for block, r, c0 in ((0, 0, 0), (1, 0, 3), (2, 3, 3)):
        t = h[6 * block : 6 * block + 6]
        hessian[r, c0] = t[0]
        hessian[r, c0 + 1] = hessian[r + 1, c0] = t[1]
        hessian[r, c0 + 2] = hessian[r + 2, c0] = t[2]
        hessian[r + 1, c0 + 1] = t[3]
        hessian[r + 1, c0 + 2] = hessian[r + 2, c0 + 1] = t[4]
        hessian[r + 2, c0 + 2] = t[5]
    for i in range(3):
        for j in range(3):
            hessian[3 + i, j] = hessian[j, 3 + i]


@summing_kernel
def reference_sums(
    count: int,
    dx: Floats,
    dy: Floats,
    f: Floats,
    gx: Floats,
    gy: Floats,
    hessian: Floats,
    j1: Floats,
    jf: Floats,
    moments: Floats,
) -> None:
    """Fill the sums of J J^T, J and J f over a subset, and of f, f^2, dx^2, dy^2.

    J = (gx, gx dx, gx dy, gy, gy dx, gy dy).
    """
    h = np.zeros(18)
    s = np.zeros(12)
    m = np.zeros(4)
    for k in range(count):
        x = dx[k]
        y = dy[k]
        v = f[k]
        xx = x * x
        xy = x * y
        yy = y * y
        p = gx[k]
        q = gy[k]
        a = p * p
        b = p * q
        c = q * q
        h[0] += a
        h[1] += a * x
        h[2] += a * y
        h[3] += a * xx
        h[4] += a * xy
        h[5] += a * yy
        h[6] += b
        h[7] += b * x
        h[8] += b * y
        h[9] += b * xx
        h[10] += b * xy
        h[11] += b * yy
        h[12] += c
        h[13] += c * x
        h[14] += c * y
        h[15] += c * xx
        h[16] += c * xy
        h[17] += c * yy
        s[0] += p
        s[1] += p * x
        s[2] += p * y
        s[3] += q
        s[4] += q * x
        s[5] += q * y
        p *= v
        q *= v
        s[6] += p
        s[7] += p * x
        s[8] += p * y
        s[9] += q
        s[10] += q * x
        s[11] += q * y
        m[0] += v
        m[1] += v * v
        m[2] += xx
        m[3] += yy
    _unpack_hessian(h, hessian)
    j1[:] = s[:6]
    jf[:] = s[6:]
    moments[:] = m


@summing_kernel
def deformed_sums(
    count: int,
    dx: Floats,
    dy: Floats,
    f: Floats,
    gx: Floats,
    gy: Floats,
    g: Floats,
    jg: Floats,
    moments: Floats,
) -> None:
    """Fill the sums of J g, and of g, g^2 and f g, over a subset."""
    s = np.zeros(9)
    for k in range(count):
        v = g[k]
        s[0] += v
        s[1] += v * v
        s[2] += v * f[k]
        a = gx[k] * v
        b = gy[k] * v
        s[3] += a
        s[4] += a * dx[k]
        s[5] += a * dy[k]
        s[6] += b
        s[7] += b * dx[k]
        s[8] += b * dy[k]
    moments[:] = s[:3]
    jg[:] = s[3:]
