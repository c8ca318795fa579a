"""Shape functions: how a subset may deform, to zeroth, first or second order.

A warp is 12 numbers: u, du/dx, du/dy, v, dv/dx, dv/dy, then the second derivatives u,xx u,xy u,yy, v,xx v,xy
v,yy, in px. The subset's pixel at (x, y) from its centre goes to

    x + u + u,x x + u,y y + u,xx x^2 / 2 + u,xy x y + u,yy y^2 / 2

and y likewise with v (thesis Eq. (1.2) to first order; Lu & Cary 2000 to second).
"""

from __future__ import annotations

from typing import Final, Literal, TypeAlias

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.compilation import inner, kernel, uncounted_kernel, uncounted_summing_kernel
from sms_jobs.metrology.images.spline import PADDING

ShapeOrder: TypeAlias = Literal[0, 1, 2]

PARAMETERS: Final = (2, 6, 12)
"""Unknowns of each order."""

WARP: Final = 12
"""Numbers of a warp of any order."""


@inner
@uncounted_kernel
def warped(warp: Floats, x: float, y: float) -> tuple[float, float]:
    """Return the displacement of a subset's pixel at (x, y) from its centre, in px."""
    xx, xy, yy = 0.5 * x * x, x * y, 0.5 * y * y
    u = warp[0] + warp[1] * x + warp[2] * y + warp[6] * xx + warp[7] * xy + warp[8] * yy
    v = warp[3] + warp[4] * x + warp[5] * y + warp[9] * xx + warp[10] * xy + warp[11] * yy
    return u, v


@inner
@uncounted_kernel
def inside(
    warp: Floats, cx: int, cy: int, left: int, right: int, top: int, bottom: int, rows: int, columns: int,
    reach: float,
) -> bool:  # fmt: skip
    """Return whether a box about (cx, cy) is warped into the image, or at most `reach` px over its border.

    The corners tell that of the first order; the second may bulge in between, by no more than is added.
    """
    x = max(abs(left), abs(right))
    y = max(abs(top), abs(bottom))
    bulge_u = 0.5 * abs(warp[6]) * x * x + abs(warp[7]) * x * y + 0.5 * abs(warp[8]) * y * y
    bulge_v = 0.5 * abs(warp[9]) * x * x + abs(warp[10]) * x * y + 0.5 * abs(warp[11]) * y * y
    for i in (left, right):
        for j in (top, bottom):
            px = cx + i + warp[0] + warp[1] * i + warp[2] * j
            py = cy + j + warp[3] + warp[4] * i + warp[5] * j
            # Written so that NaN is outside.
            if not (px - bulge_u >= -reach and px + bulge_u <= columns - 1 + reach):
                return False
            if not (py - bulge_v >= -reach and py + bulge_v <= rows - 1 + reach):
                return False
    return True


@inner
@uncounted_summing_kernel
def places(
    warp: Floats, order: int, cx: int, cy: int, columns: int, count: int, dx: Floats, dy: Floats,
    first: Ints, s: Floats, t: Floats,
) -> None:  # fmt: skip
    """Fill where a subset's pixels go, as `spline_values` wants it; `columns` is the coefficients'."""
    x0, ux, uy = cx + warp[0] + PADDING, 1.0 + warp[1], warp[2]
    y0, vx, vy = cy + warp[3] + PADDING, warp[4], 1.0 + warp[5]
    if order < 2:
        for k in range(count):
            px = x0 + ux * dx[k] + uy * dy[k]
            py = y0 + vx * dx[k] + vy * dy[k]
            # Of 32 bits: most machines convert several of these at a time, and longer ones by themselves.
            column = np.int32(px)
            row = np.int32(py)
            s[k] = px - column
            t[k] = py - row
            first[k] = (np.int64(row) - 2) * columns + column - 2
        return
    uxx, uxy, uyy = 0.5 * warp[6], warp[7], 0.5 * warp[8]
    vxx, vxy, vyy = 0.5 * warp[9], warp[10], 0.5 * warp[11]
    for k in range(count):
        x = dx[k]
        y = dy[k]
        px = x0 + (ux + uxx * x + uxy * y) * x + (uy + uyy * y) * y
        py = y0 + (vx + vxx * x + vxy * y) * x + (vy + vyy * y) * y
        column = np.int32(px)
        row = np.int32(py)
        s[k] = px - column
        t[k] = py - row
        first[k] = (np.int64(row) - 2) * columns + column - 2


@inner
@uncounted_kernel
def _bend(warp: Floats, ax: float, ay: float, bx: float, by: float) -> tuple[float, float]:
    """Return the second derivative of a warp along (ax, ay) and (bx, by)."""
    mixed = ax * by + ay * bx
    u = warp[6] * ax * bx + warp[7] * mixed + warp[8] * ay * by
    v = warp[9] * ax * bx + warp[10] * mixed + warp[11] * ay * by
    return u, v


@inner
@kernel
def compose_inverse(warp: Floats, step: Floats) -> None:
    """Replace the warp W(p) by W(p) o W(step)^-1, exactly to the order of the warps at the subset's centre.

    What two quadratic warps make together is not quadratic; value, slope and curvature at the centre are
    kept, as the 6 x 6 matrices of Gao et al. 2015 keep them for small steps, in closed form: with x0 the
    point that the step takes to the centre, M the inverse of its slope there and Q its curvature, the
    inverse step has slope M and curvature -M Q(M ., M .), and the rest is the chain rule.
    """
    # x0 by Newton's method; the first pass is exact for the first order.
    x, y = 0.0, 0.0
    m00, m01, m10, m11 = 1.0, 0.0, 0.0, 1.0
    bent = False
    for i in range(6, 12):
        bent |= step[i] != 0.0
    for repeat in range(5 if bent else 1):
        u, v = 0.0, 0.0
        if repeat > 0:
            u, v = warped(step, x, y)
            u += x
            v += y
        else:
            u, v = step[0], step[3]
        a = 1.0 + step[1] + step[6] * x + step[7] * y
        b = step[2] + step[7] * x + step[8] * y
        c = step[4] + step[9] * x + step[10] * y
        d = 1.0 + step[5] + step[10] * x + step[11] * y
        determinant = a * d - b * c
        m00, m01, m10, m11 = d / determinant, -b / determinant, -c / determinant, a / determinant
        x -= m00 * u + m01 * v
        y -= m10 * u + m11 * v
    # Slope of W(p) at x0, then the chain rule.
    p00 = 1.0 + warp[1] + warp[6] * x + warp[7] * y
    p01 = warp[2] + warp[7] * x + warp[8] * y
    p10 = warp[4] + warp[9] * x + warp[10] * y
    p11 = 1.0 + warp[5] + warp[10] * x + warp[11] * y
    u, v = warped(warp, x, y)
    k = 6
    curvature = np.zeros(6)
    for ax, ay, bx, by in ((m00, m10, m00, m10), (m00, m10, m01, m11), (m01, m11, m01, m11)):
        q0, q1 = _bend(step, ax, ay, bx, by)
        i0, i1 = -(m00 * q0 + m01 * q1), -(m10 * q0 + m11 * q1)  # curvature of the inverse step
        w0, w1 = _bend(warp, ax, ay, bx, by)
        curvature[k - 6] = w0 + p00 * i0 + p01 * i1
        curvature[k - 3] = w1 + p10 * i0 + p11 * i1
        k += 1
    warp[0] = x + u
    warp[3] = y + v
    warp[1] = p00 * m00 + p01 * m10 - 1.0
    warp[2] = p00 * m01 + p01 * m11
    warp[4] = p10 * m00 + p11 * m10
    warp[5] = p10 * m01 + p11 * m11 - 1.0
    for i in range(6):
        warp[6 + i] = curvature[i]


def shifted(warp: Floats, dx: Floats | Ints, dy: Floats | Ints) -> Floats:
    """Return the displacements (..., 2) that warps (..., 6 or 12) tell of points (dx, dy) away, in px."""
    shift = np.empty((*np.broadcast_shapes(warp.shape[:-1], np.shape(dx)), 2))
    for axis in range(2):
        value, slope, bend = 3 * axis, 3 * axis + 1, 6 + 3 * axis
        moved = warp[..., value] + (warp[..., slope] * dx + warp[..., slope + 1] * dy)
        if warp.shape[-1] == WARP:
            xx, xy, yy = (warp[..., bend + i] for i in range(3))
            moved = moved + (0.5 * xx * dx**2 + xy * dx * dy + 0.5 * yy * dy**2)
        shift[..., axis] = moved
    return shift


def carried(warp: Floats, dx: Floats | Ints, dy: Floats | Ints) -> Floats:
    """Return warps (..., 6 or 12) as seen from points (dx, dy) away, in px.

    Six numbers are a warp without curvature, and stay six.
    """
    moved = warp.copy()
    moved[..., [0, 3]] = shifted(warp, dx, dy)
    if warp.shape[-1] == WARP:
        for slope, bend in ((1, 6), (4, 9)):
            xx, xy, yy = (warp[..., bend + i] for i in range(3))
            moved[..., slope] += xx * dx + xy * dy
            moved[..., slope + 1] += xy * dx + yy * dy
    return moved
