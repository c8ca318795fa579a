"""The error that the bend of a surface within a pixel makes in its depth.

A pixel sees the mean over its spot. Of a surface that bends, this is not the value in the middle: a Gaussian
spot of variance s^2 adds s^2 / 2 times the Laplacian, by which a ball looks smaller and its limb lies behind
it. Inverse depth is used, which is linear over the image of a plane. Second derivatives are told by parabolas
through five pixels, as a mean over five lines beside each other.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inner, uncounted_kernel

_REACH = 2  # px to the outermost pixel of a parabola, and to the outermost line
_LIMIT = 20.0  # deviations that the five may lie off their parabola: what is farther is no bend but a step
_GROWTH = 3.0
"""How many times a limb may bend a pixel outwards: 1.6 and 2.7 on a ball of 16 px, up to 68 degrees."""
_OFF = 2.0 / 7.0 / sqrt(1.0 / 10.0 + 1.0 / 70.0)
"""By how much a step of 1 bends the parabola, for each unit that it is off it: the most of any place."""


@uncounted_kernel
def _bends(
    inverse: Floats, sigma: Floats, down: int, start: int, stop: int, bent: Floats, off: Floats
) -> None:
    """Write the second derivative along columns (down = 0) or rows, NaN where there is none.

    And the squared distance of the five pixels from their parabola, beyond that of noise, which has two
    degrees of freedom. `inverse` is NaN where it is not known.
    """
    rows, columns = inverse.shape
    right = 1 - down
    r, c = _REACH * down, _REACH * right
    for row in range(start, stop):
        bent[row] = np.nan
        if row < r or row >= rows - r:
            continue
        for column in range(c, columns - c):
            first, last = inverse[row - r, column - c], inverse[row + r, column + c]
            before, after = inverse[row - down, column - right], inverse[row + down, column + right]
            here = inverse[row, column]
            third = last - first - 2.0 * (after - before)
            fourth = last + first - 4.0 * (after + before) + 6.0 * here
            square = third * third / 10.0 + fourth * fourth / 70.0
            v0, v1 = sigma[row - r, column - c] ** 2, sigma[row - down, column - right] ** 2
            v3, v4 = sigma[row + down, column + right] ** 2, sigma[row + r, column + c] ** 2
            noise = (8.0 * (v0 + v4) + 44.0 * (v1 + v3) + 36.0 * sigma[row, column] ** 2) / 70.0
            if square <= 0.5 * _LIMIT * _LIMIT * noise:
                bent[row, column] = (2.0 * (last + first - here) - before - after) / 7.0
                off[row, column] = max(square - noise, 0.0)


@inner
@uncounted_kernel
def _nearest(bent: Floats, usable: Mask, row: int, column: int, down: int) -> tuple[int, int]:
    """Return the nearest pixel along an axis that has a bend, over usable ones; (-1, -1) if there is none."""
    if not usable[row, column]:
        return -1, -1
    for step in range(_REACH + 1):
        for sign in (-1, 1):
            i, j = row + sign * step * down, column + sign * step * (1 - down)
            between = row + sign * down, column + sign * (1 - down)
            if not (0 <= i < bent.shape[0] and 0 <= j < bent.shape[1]) or np.isnan(bent[i, j]):
                continue
            if step < _REACH or usable[between]:
                return i, j
    return -1, -1


@uncounted_kernel
def _add_means(
    usable: Mask, bent: Floats, off: Floats, down: int, start: int, stop: int, half: Floats, unsure: Floats
) -> None:
    """Add the half of the mean over the lines beside each other to `half`, and its variance to `unsure`."""
    rows, columns = bent.shape
    for row in range(start, stop):
        for column in range(columns):
            r, c = _nearest(bent, usable, row, column, down)
            if r < 0:
                continue
            total, count = 0.0, 0
            for k in range(-_REACH, _REACH + 1):
                i, j = r + k * (1 - down), c + k * down
                if 0 <= i < rows and 0 <= j < columns and not np.isnan(bent[i, j]):
                    total += bent[i, j]
                    count += 1
            half[row, column] += 0.5 * total / count
            growth = _GROWTH ** (abs(r - row) + abs(c - column)) - 1.0
            unsure[row, column] += 0.25 * (_OFF * _OFF * off[r, c] + (growth * total / count) ** 2)


def half_laplacian(inverse: Floats, sigma: Floats, threads: int = 1) -> tuple[Floats, Floats]:
    """Return by how much the bend of a surface moves its inverse depth, for each unit of s^2.

    Parameters
    ----------
    inverse, sigma
        (rows, columns) in 1/mm: inverse depths, NaN where nothing is known, and their standard deviations.
    threads
        Number of threads; the result does not depend on it.

    Returns
    -------
    (rows, columns), in 1/mm/px^2: the half of the Laplacian; and how uncertain it is, as a standard
    deviation. A pixel whose five are not all known, or lie on no parabola, has the bend of the nearest within
    two pixels, uncertain by twice or eight times that: limbs bend ever more. Else the axis counts 0.

    Notes
    -----
    Of noise alone the mean over five lines has 0.24 of its deviation as second derivative, and 0.36 of it is
    said to be uncertain, of each axis. At s^2 = 1/3 the variance grows by 4 %, since the parabola contains
    the pixel itself, and 3 % are said. Near a step, or where a limb bends ever more, the five pixels are off
    their parabola by more than what that makes wrong in it.
    """
    usable = np.isfinite(inverse)
    half, variance = np.zeros_like(inverse), np.zeros_like(inverse)
    bent, off = np.empty_like(inverse), np.empty_like(inverse)
    for down in (0, 1):

        def bends(start: int, stop: int, down: int = down) -> None:
            _bends(inverse, sigma, down, start, stop, bent, off)

        def means(start: int, stop: int, down: int = down) -> None:
            _add_means(usable, bent, off, down, start, stop, half, variance)

        in_row_blocks(bends, len(usable), threads)
        in_row_blocks(means, len(usable), threads)
    return half, np.sqrt(variance, out=variance)
