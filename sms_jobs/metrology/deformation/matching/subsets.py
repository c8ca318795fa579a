"""The pixels of a subset that lie on its region, and the sums over them that matching needs."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints, Labels
from sms_jobs.metrology.compilation import inlined, inner, kernel, uncounted_kernel, uncounted_summing_kernel
from sms_jobs.metrology.deformation.matching.shape_functions import inside

_FLAT = 0.01  # determinant below which a subset is seen edge-on: nothing is known of its blur
RIM = 5  # px at an image's border where reflection bends its spline: the effect falls by 0.43 a pixel


@inlined
def blur_tensor(
    spots: tuple[float, float], ux: float, uy: float, vx: float, vy: float
) -> tuple[float, float, float]:
    """Return xx, xy and yy of s_1 (F^T F)^-1 - s_0 for F = 1 + grad u; 0 where a subset folds up.

    By so much the deformed image's spot, round there and of variance s_1, is wider in the reference image
    than that one's own of variance s_0.
    """
    xx = (1.0 + ux) ** 2 + vx**2
    xy = (1.0 + ux) * uy + vx * (1.0 + vy)
    yy = uy**2 + (1.0 + vy) ** 2
    determinant = xx * yy - xy * xy
    if not determinant > _FLAT:
        return 0.0, 0.0, 0.0
    scale = spots[1] / determinant
    return scale * yy - spots[0], -scale * xy, scale * xx - spots[0]


@inlined
def blurred_more(
    gradient_x: Floats, gradient_y: Floats, r: int, c: int, tensor: tuple[float, float, float]
) -> float:
    """Return what blurring by variances `tensor` adds to a grey level: half of them times its curvature."""
    xx, xy, yy = tensor
    # Unsigned indices need no look at their sign: several pixels are then done at a time.
    row, column = np.uint64(r), np.uint64(c)
    above, below, left, right = np.uint64(r - 1), np.uint64(r + 1), np.uint64(c - 1), np.uint64(c + 1)
    along_x = gradient_x[row, right] - gradient_x[row, left]
    across = gradient_x[below, column] - gradient_x[above, column]
    along_y = gradient_y[below, column] - gradient_y[above, column]
    return float(0.25 * (xx * along_x + 2.0 * xy * across + yy * along_y))


@inner
@uncounted_kernel
def collect(
    reference: Floats, gradient_x: Floats, gradient_y: Floats, labels: Labels, cx: int, cy: int, radius: int,
    warp: Floats, spots: tuple[float, float],
    dx: Floats, dy: Floats, f: Floats, gx: Floats, gy: Floats, box: Ints,
) -> int:  # fmt: skip
    """Fill a subset's offsets, grey levels and slopes and their bounding box; return its number of pixels.

    A pixel belongs if it lies on the centre's region and neither it nor its expected counterpart lies at the
    border of its image.

    The grey levels are blurred, or sharpened, as the deformed image shows them. Its spot (variance in px^2)
    may be another one, and a subset that it shows larger is blurred less there, and one that it shows smaller
    more: to first order by half of that times the second derivatives.
    """
    rows, columns = labels.shape
    label = labels[cy, cx]
    left = max(-radius, RIM - cx)
    right = min(radius, columns - 1 - RIM - cx)
    top = max(-radius, RIM - cy)
    bottom = min(radius, rows - 1 - RIM - cy)
    whole = inside(warp, cx, cy, left, right, top, bottom, rows, columns, -float(RIM))
    tensor = blur_tensor(spots, warp[1], warp[2], warp[4], warp[5])
    blurred = spots[0] + spots[1] > 0.0
    box[0], box[1], box[2], box[3] = right, left, bottom, top
    count = 0
    width = max(right - left + 1, 0)
    for j in range(top, bottom + 1):
        row = np.uint64(cy + j)
        first = count
        own = 0
        for i in range(width):
            own += labels[row, np.uint64(cx + left + i)] == label
        if whole and own == width:
            # A loop for each array: one over several looks whether they overlap for longer than it copies.
            # Unsigned indices need no look at their sign, which would keep this from being vector copies.
            for i in range(width):
                dx[np.uint64(first + i)] = left + i
            for i in range(width):
                dy[np.uint64(first + i)] = j
            for i in range(width):
                f[np.uint64(first + i)] = reference[row, np.uint64(cx + left + i)]
            for i in range(width):
                gx[np.uint64(first + i)] = gradient_x[row, np.uint64(cx + left + i)]
            for i in range(width):
                gy[np.uint64(first + i)] = gradient_y[row, np.uint64(cx + left + i)]
            if blurred:
                for i in range(width):
                    more = blurred_more(gradient_x, gradient_y, cy + j, cx + left + i, tensor)
                    f[np.uint64(first + i)] += more
            count += width
        elif own > 0:
            for i in range(left, right + 1):
                column = np.uint64(cx + i)
                if labels[row, column] != label:
                    continue
                if not whole and not inside(warp, cx, cy, i, i, j, j, rows, columns, -float(RIM)):
                    continue
                dx[count] = i
                dy[count] = j
                f[count] = reference[row, column]
                if blurred:
                    f[count] += blurred_more(gradient_x, gradient_y, cy + j, cx + i, tensor)
                gx[count] = gradient_x[row, column]
                gy[count] = gradient_y[row, column]
                count += 1
        if count > first:
            box[0] = min(box[0], int(dx[first]))
            box[1] = max(box[1], int(dx[count - 1]))
            box[2] = min(box[2], j)
            box[3] = j
    return count


# Sums are local numbers, not elements of an array: only then are several pixels added at a time.


@inner
@uncounted_summing_kernel
def _slope_sums(
    count: int, weight: Floats, f: Floats, x: Floats, y: Floats, order: int, sums: Floats
) -> None:
    """Fill the sums of w, w x, w y, w f, w f x, w f y, and to second order of w x^2 .. and w f x^2 .."""
    s, sx, sy, sf, sfx, sfy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        w = weight[k]
        wx = w * x[k]
        wy = w * y[k]
        s += w
        sx += wx
        sy += wy
        sf += w * f[k]
        sfx += wx * f[k]
        sfy += wy * f[k]
    sums[0], sums[1], sums[2], sums[6], sums[7], sums[8] = s, sx, sy, sf, sfx, sfy
    if order > 1:
        s, sx, sy, sf, sfx, sfy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            xx = weight[k] * x[k] * x[k]
            xy = weight[k] * x[k] * y[k]
            yy = weight[k] * y[k] * y[k]
            s += xx
            sx += xy
            sy += yy
            sf += xx * f[k]
            sfx += xy * f[k]
            sfy += yy * f[k]
        sums[3], sums[4], sums[5] = 0.5 * s, sx, 0.5 * sy
        sums[9], sums[10], sums[11] = 0.5 * sf, sfx, 0.5 * sfy


@inner
@uncounted_summing_kernel
def _product_sums(count: int, a: Floats, b: Floats, x: Floats, y: Floats, order: int, h: Floats) -> None:
    """Fill the sums of a b x^i y^j, i + j up to 2 or to 4: (0, 0), (1, 0), (0, 1), (2, 0), (1, 1) .."""
    s, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        w = a[k] * b[k]
        wx = w * x[k]
        wy = w * y[k]
        s += w
        sx += wx
        sy += wy
        sxx += wx * x[k]
        sxy += wx * y[k]
        syy += wy * y[k]
    h[0], h[1], h[2], h[3], h[4], h[5] = s, sx, sy, sxx, sxy, syy
    if order > 1:
        xxx, xxy, xyy, yyy = 0.0, 0.0, 0.0, 0.0
        x4, x3y, x2y2, xy3, y4 = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            w = a[k] * b[k]
            xx = x[k] * x[k]
            yy = y[k] * y[k]
            wxx = w * xx
            wyy = w * yy
            wxy = w * x[k] * y[k]
            xxx += wxx * x[k]
            xxy += wxx * y[k]
            xyy += wyy * x[k]
            yyy += wyy * y[k]
            x4 += wxx * xx
            x3y += wxy * xx
            x2y2 += wxx * yy
            xy3 += wxy * yy
            y4 += wyy * yy
        h[6], h[7], h[8], h[9] = xxx, xxy, xyy, yyy
        h[10], h[11], h[12], h[13], h[14] = x4, x3y, x2y2, xy3, y4


_X_POWER = np.array([0, 1, 0, 2, 1, 0])
_Y_POWER = np.array([0, 0, 1, 0, 1, 2])
_FACTOR = np.array([1.0, 1.0, 1.0, 0.5, 1.0, 0.5])  # of the terms of a shape function: x^2 / 2, y^2 / 2
_PLACE_U = np.array([0, 1, 2, 6, 7, 8])  # of the terms of u in a warp, and of v
_PLACE_V = np.array([3, 4, 5, 9, 10, 11])


@inner
@uncounted_kernel
def _unpack(h: Floats, rows: Ints, columns: Ints, terms: int, hessian: Floats) -> None:
    """Spread sums of x^i y^j, as `_product_sums` has them, over a block of the normal matrix."""
    for m in range(terms):
        for n in range(terms):
            i, j = _X_POWER[m] + _X_POWER[n], _Y_POWER[m] + _Y_POWER[n]
            value = h[(i + j) * (i + j + 1) // 2 + j] * _FACTOR[m] * _FACTOR[n]
            hessian[rows[m], columns[n]] = value
            hessian[columns[n], rows[m]] = value


@inner
@uncounted_summing_kernel
def _levels(count: int, dx: Floats, dy: Floats, f: Floats, moments: Floats) -> None:
    """Fill the sums of f, f^2, dx^2, dy^2."""
    total, square, xx, yy = 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        total += f[k]
        square += f[k] * f[k]
        xx += dx[k] * dx[k]
        yy += dy[k] * dy[k]
    moments[0], moments[1], moments[2], moments[3] = total, square, xx, yy


@inner
@kernel
def reference_sums(
    count: int, dx: Floats, dy: Floats, f: Floats, gx: Floats, gy: Floats, order: int,
    hessian: Floats, j1: Floats, jf: Floats, moments: Floats,
) -> None:  # fmt: skip
    """Fill the sums of J J^T, J and J f over a subset, and of f, f^2, dx^2, dy^2.

    J are the slopes along the numbers of a warp: (gx, gx dx, gx dy, gy, gy dx, gy dy), and for the second
    order (gx dx^2 / 2, gx dx dy, gx dy^2 / 2, gy dx^2 / 2, ..). `j1` and `jf` have room for 12.
    """
    terms = 6 if order > 1 else 3
    h = np.empty(15)
    _product_sums(count, gx, gx, dx, dy, order, h)
    _unpack(h, _PLACE_U, _PLACE_U, terms, hessian)
    _product_sums(count, gx, gy, dx, dy, order, h)
    _unpack(h, _PLACE_U, _PLACE_V, terms, hessian)
    _product_sums(count, gy, gy, dx, dy, order, h)
    _unpack(h, _PLACE_V, _PLACE_V, terms, hessian)
    _slope_sums(count, gx, f, dx, dy, order, h)
    for m in range(terms):
        j1[_PLACE_U[m]] = h[m]
        jf[_PLACE_U[m]] = h[6 + m]
    _slope_sums(count, gy, f, dx, dy, order, h)
    for m in range(terms):
        j1[_PLACE_V[m]] = h[m]
        jf[_PLACE_V[m]] = h[6 + m]
    _levels(count, dx, dy, f, moments)


@inner
@uncounted_summing_kernel
def deformed_sums(
    count: int, dx: Floats, dy: Floats, f: Floats, gx: Floats, gy: Floats, g: Floats, order: int,
    jg: Floats, moments: Floats,
) -> None:  # fmt: skip
    """Fill the sums of J g, and of g, g^2 and f g, over a subset."""
    total, square, product = 0.0, 0.0, 0.0
    a0, ax, ay, b0, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        v = g[k]
        total += v
        square += v * v
        product += v * f[k]
        a = gx[k] * v
        b = gy[k] * v
        a0 += a
        ax += a * dx[k]
        ay += a * dy[k]
        b0 += b
        bx += b * dx[k]
        by += b * dy[k]
    moments[0], moments[1], moments[2] = total, square, product
    jg[0], jg[1], jg[2], jg[3], jg[4], jg[5] = a0, ax, ay, b0, bx, by
    if order > 1:
        axx, axy, ayy, bxx, bxy, byy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            xx = dx[k] * dx[k]
            xy = dx[k] * dy[k]
            yy = dy[k] * dy[k]
            a = gx[k] * g[k]
            b = gy[k] * g[k]
            axx += a * xx
            axy += a * xy
            ayy += a * yy
            bxx += b * xx
            bxy += b * xy
            byy += b * yy
        jg[6], jg[7], jg[8] = 0.5 * axx, axy, 0.5 * ayy
        jg[9], jg[10], jg[11] = 0.5 * bxx, bxy, 0.5 * byy
