"""Means over windows, and arithmetic on maps of them, pixel by pixel: one pass each, where NumPy makes many.

All maps are (rows, columns); the last arguments are filled.
"""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.compilation import inlined, uncounted_kernel

_LEAST_SHARE = 0.1  # of a square's pixels that must be known to tell the mean of all


@inlined
def _least(a: float, b: float) -> float:
    """Return the smaller number, or NaN where one is."""
    return a if (a < b) | (a != a) else b


@inlined
def _most(a: float, b: float) -> float:
    """Return the larger number, or NaN where one is."""
    return a if (a > b) | (a != a) else b


def means(values: Floats, radius: int) -> Floats:
    """Return the means over squares of 2 radius + 1 pixels, of what is 0 beyond the border."""
    import cv2

    size = (2 * radius + 1, 2 * radius + 1)
    return np.asarray(cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_CONSTANT))


def means_of(values: Floats, known: Mask, radius: int) -> Floats:
    """Return the means of what is known in such squares; NaN where that is less than a tenth of one."""
    share = means(known.astype(np.float64), radius)
    total = means(np.where(known, values, 0.0), radius)
    enough = share > _LEAST_SHARE
    return np.where(enough, total / np.where(enough, share, 1.0), np.nan)


@uncounted_kernel
def trusted_products(
    f: Floats, g: Floats, trusted: Mask, f_only: Floats, g_only: Floats, gg: Floats, fg: Floats
) -> None:
    """Fill in f, g, g^2 and f g, 0 where they are not trusted."""
    rows, columns = f.shape
    for r in range(rows):
        for c in range(columns):
            a = f[r, c] if trusted[r, c] else 0.0
            b = g[r, c] if trusted[r, c] else 0.0
            f_only[r, c] = a
            g_only[r, c] = b
            gg[r, c] = b * b
            fg[r, c] = a * b


@uncounted_kernel
def without_light(
    f: Floats, g: Floats, known: Mask, weight: Floats, means: tuple[Floats, Floats, Floats, Floats],
    residual: Floats, gain: Floats, texture: Floats,
) -> None:  # fmt: skip
    """Fill in f - b g and the gain b, both less their means, and f less its mean; 0 where nothing is known.

    `weight` is the trusted part of each window, `means` are those of `trusted_products` over all of it.
    """
    f_means, g_means, gg_means, fg_means = means
    rows, columns = f.shape
    for r in range(rows):
        for c in range(columns):
            part = _most(weight[r, c], 1e-12)
            f_mean, g_mean = f_means[r, c] / part, g_means[r, c] / part
            gg = gg_means[r, c] / part - g_mean * g_mean
            fg = fg_means[r, c] / part - f_mean * g_mean
            b = fg / gg if gg > 0.0 else 0.0
            gain[r, c] = b
            own = f[r, c] - f_mean
            texture[r, c] = own if known[r, c] else 0.0
            residual[r, c] = own - b * (g[r, c] - g_mean) if known[r, c] else 0.0


@uncounted_kernel
def solved(
    normal: tuple[Floats, Floats, Floats], right: tuple[Floats, Floats], variance: Floats, pixels: int,
    asked: Floats, spread: Floats,
) -> None:  # fmt: skip
    """Fill in the displacement (2, ..) that solves the normal equations of windows, and its variance.

    `normal` has the means of gx^2, gx gy and gy^2, `right` those of the slopes times the residual, `variance`
    is that of a pixel, of which a window has so many.
    """
    xx, xy, yy = normal
    along_x, along_y = right
    rows, columns = variance.shape
    for r in range(rows):
        # A loop for each number: of one that fills several the compiler does not do several pixels at a time.
        for c in range(columns):
            determinant = xx[r, c] * yy[r, c] - xy[r, c] * xy[r, c]
            asked[0, r, c] = (yy[r, c] * along_x[r, c] - xy[r, c] * along_y[r, c]) / determinant
        for c in range(columns):
            determinant = xx[r, c] * yy[r, c] - xy[r, c] * xy[r, c]
            asked[1, r, c] = (xx[r, c] * along_y[r, c] - xy[r, c] * along_x[r, c]) / determinant
        for c in range(columns):
            determinant = xx[r, c] * yy[r, c] - xy[r, c] * xy[r, c]
            spread[0, r, c] = variance[r, c] / pixels * yy[r, c] / determinant
        for c in range(columns):
            determinant = xx[r, c] * yy[r, c] - xy[r, c] * xy[r, c]
            spread[1, r, c] = variance[r, c] / pixels * xx[r, c] / determinant


@uncounted_kernel
def weighed(
    asked: Floats, noise: Floats, counts: Mask, typical: float,
    weight: Floats, excess: Floats, chance: Floats,
) -> None:  # fmt: skip
    """Fill in what windows weigh, times what their squares have beyond noise, and its square by chance."""
    rows, columns = asked.shape
    for r in range(rows):
        for c in range(columns):
            a, n = asked[r, c], noise[r, c]
            share = typical / (n + typical)
            w = share * share if counts[r, c] else 0.0
            weight[r, c] = w
            excess[r, c] = w * (a * a - n)
            chance[r, c] = (w * n) * (w * n)


@uncounted_kernel
def bounded(
    found: Floats, means: tuple[Floats, Floats, Floats], independent: float, least: float, at_most: float,
    bound: Floats,
) -> None:  # fmt: skip
    """Fill in means over squares of windows, or `found` as far as it has room, where they are no chance.

    `means` are those of what `weighed` fills in; so many windows of a square are `independent`. A mean is no
    chance from `least` of its standard errors on, and bounds `found` at `at_most` of them above it.
    """
    weight, excess, chance = means
    rows, columns = found.shape
    for r in range(rows):
        for c in range(columns):
            total = _most(weight[r, c], 1e-9)
            mean = excess[r, c] / total
            error = np.sqrt(2.0 * _most(chance[r, c], 0.0) / independent) / total
            room = _least(found[r, c], _most(mean, 0.0) + at_most * error)
            bound[r, c] = _most(room, mean if mean > least * error else 0.0)


@uncounted_kernel
def variances(
    f: Floats, g: Floats, gain: Floats, noise: tuple[float, float, float, float], least: float,
    variance: Floats,
) -> None:  # fmt: skip
    """Fill in the variance of f - b g; `noise` is floor and slope of f's and of g's, each at `least`."""
    rows, columns = f.shape
    for r in range(rows):
        for c in range(columns):
            own = _most(noise[0] + noise[1] * f[r, c], least)
            other = _most(noise[2] + noise[3] * g[r, c], least)
            variance[r, c] = own + gain[r, c] * gain[r, c] * other


@uncounted_kernel
def raise_where_sure(
    asked: Floats, spread: Floats, roughness: Floats, known: Mask, sigmas: float, square: Floats
) -> None:
    """Raise `square` (2, ..) to that of what is asked for, where it is more than so many `sigmas`."""
    rows, columns = known.shape
    for i in range(2):
        for r in range(rows):
            for c in range(columns):
                own = asked[i, r, c] * asked[i, r, c]
                sure = known[r, c] & (own > sigmas * sigmas * roughness[r, c] * spread[i, r, c])
                square[i, r, c] = _most(square[i, r, c], own if sure else 0.0)


@uncounted_kernel
def mended_squares(
    residual: Floats, asked: Floats, slopes: tuple[Floats, Floats], masks: tuple[Mask, Mask], far: float,
    squares: Floats,
) -> None:  # fmt: skip
    """Fill in squares of residuals, where pixels are alike as far as a step that is not too `far` mends them.

    `masks` are the pixels that are alike, and those that are known; 0 for others.
    """
    gx, gy = slopes
    like, known = masks
    rows, columns = residual.shape
    for r in range(rows):
        for c in range(columns):
            u = asked[0, r, c] if abs(asked[0, r, c]) < far else 0.0
            v = asked[1, r, c] if abs(asked[1, r, c]) < far else 0.0
            left = residual[r, c]
            mended = left - u * gx[r, c] - v * gy[r, c]
            square = left * left if known[r, c] else 0.0
            squares[r, c] = _least(mended * mended, left * left) if like[r, c] else square
