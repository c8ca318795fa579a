"""Averages of noisy fields over pixels of one region."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Labels, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel

OUTLIER = 5.0
"""Standard deviations beyond which a pixel is no part of the surface around it."""


@inner
@uncounted_kernel
def _gather_disc(
    r: int, c: int, labels: Labels, weight: Floats, radius: float, place: Ints, w: Floats
) -> int:
    """Fill the rows and columns and the weights of pixels about one; return their number."""
    rows, columns = labels.shape
    reach = int(np.ceil(radius)) - 1
    n = 0
    for j in range(max(r - reach, 0), min(r + reach + 1, rows)):
        for i in range(max(c - reach, 0), min(c + reach + 1, columns)):
            d2 = ((i - c) ** 2 + (j - r) ** 2) / (radius * radius)
            if d2 < 1.0 and labels[j, i] == labels[r, c] and weight[j, i] > 0.0:
                place[n, 0] = j
                place[n, 1] = i
                w[n] = (1.0 - d2) ** 2 * weight[j, i]
                n += 1
    return n


@inner
@uncounted_kernel
def _fit_shares(r: int, c: int, n: int, place: Ints, w: Floats, shares: Floats) -> bool:
    """Fill each pixel's shares (n, 3) in the value and slopes at (c, r) of a plane fitted with weights w."""
    m0 = m1 = m2 = m3 = m4 = m5 = 0.0
    for k in range(n):
        dx = place[k, 1] - c
        dy = place[k, 0] - r
        m0 += w[k]
        m1 += w[k] * dx
        m2 += w[k] * dy
        m3 += w[k] * dx * dx
        m4 += w[k] * dx * dy
        m5 += w[k] * dy * dy
    # The inverse of the normal matrix, by cofactors.
    c00 = m3 * m5 - m4 * m4
    c01 = m2 * m4 - m1 * m5
    c02 = m1 * m4 - m2 * m3
    c11 = m0 * m5 - m2 * m2
    c12 = m1 * m2 - m0 * m4
    c22 = m0 * m3 - m1 * m1
    determinant = m0 * c00 + m1 * c01 + m2 * c02
    if not determinant > 1e-6 * m0 * (m3 + m5) ** 2:
        return False
    for k in range(n):
        dx = place[k, 1] - c
        dy = place[k, 0] - r
        share = w[k] / determinant
        shares[k, 0] = share * (c00 + c01 * dx + c02 * dy)
        shares[k, 1] = share * (c01 + c11 * dx + c12 * dy)
        shares[k, 2] = share * (c02 + c12 * dx + c22 * dy)
    return True


@inner
@uncounted_kernel
def _drop_outliers(
    r: int,
    c: int,
    n: int,
    place: Ints,
    w: Floats,
    shares: Floats,
    raw: Floats,
    weight: Floats,
    plane: Floats,
) -> None:
    """Set the weight of pixels to 0 that lie too far from the plane; fill its `plane` (3, 3)."""
    for a in range(3):
        for b in range(3):
            plane[a, b] = 0.0
    for k in range(n):
        row, column = place[k, 0], place[k, 1]
        for a in range(3):
            for b in range(3):
                plane[a, b] += shares[k, b] * raw[a, row, column]
    for k in range(n):
        row, column = place[k, 0], place[k, 1]
        square = 0.0
        for a in range(3):
            fit = plane[a, 0] + plane[a, 1] * (column - c) + plane[a, 2] * (row - r)
            square += (raw[a, row, column] - fit) ** 2
        if square * weight[row, column] > OUTLIER**2:
            w[k] = 0.0


@kernel
def _average_rows(
    start: int,
    stop: int,
    labels: Labels,
    raw: Floats,
    covariance: Floats,
    weight: Floats,
    radius: float,
    value: Floats,
    spread: Floats,
) -> None:
    """Do the work of `average_in_region` for rows start .. stop."""
    size = (4 * int(np.ceil(radius)) + 1) ** 2
    place = np.empty((size, 2), dtype=np.int64)
    w = np.empty(size)
    shares, plane = np.empty((size, 3)), np.empty((3, 3))
    for r in range(start, stop):
        for c in range(labels.shape[1]):
            for a in range(6):
                value[a % 3, r, c] = spread[a, r, c] = np.nan
            if labels[r, c] == 0:
                continue
            n = _gather_disc(r, c, labels, weight, radius, place, w)
            if 2 * n < np.pi * radius**2:
                # At an edge a plane needs a longer lever.
                n = _gather_disc(r, c, labels, weight, 2.0 * radius, place, w)
            if not _fit_shares(r, c, n, place, w, shares):
                continue
            _drop_outliers(r, c, n, place, w, shares, raw, weight, plane)
            if not _fit_shares(r, c, n, place, w, shares):
                continue
            for a in range(6):
                value[a % 3, r, c] = spread[a, r, c] = 0.0
            for k in range(n):
                if w[k] > 0.0:
                    row, column, share = place[k, 0], place[k, 1], shares[k, 0]
                    for a in range(3):
                        value[a, r, c] += share * raw[a, row, column]
                    for a in range(6):
                        spread[a, r, c] += share**2 * covariance[a, row, column]


def average_in_region(
    raw: Floats,
    covariance: Floats,
    labels: NDArray[np.int32],
    usable: Mask,
    radius: float,
    threads: int = 1,
    independent: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Fit a plane to a noisy field about every pixel, over pixels of its region, and take its value there.

    Parameters
    ----------
    raw, covariance
        (3, rows, columns) and (6, rows, columns), of each pixel by itself.
    labels
        (rows, columns), 0 where there is no region.
    usable
        (rows, columns): which pixels may contribute.
    radius
        In px; pixels at distance d count by (1 - d^2 / radius^2)^2 over their variance. It is doubled where
        fewer than half the disc's pixels are there.
    threads
        How many threads to use.
    independent
        (6, rows, columns): what of the covariance is independent from pixel to pixel; the rest cancels in a
        mean. None if all of it is independent.

    Returns
    -------
    The averaged field and its covariance; NaN where fewer than three pixels contribute. Pixels five
    standard deviations off the first fit do not contribute.
    """
    variance = covariance[0] + covariance[3] + covariance[5]
    valid = usable & np.isfinite(raw).all(axis=0) & np.isfinite(variance)
    weight = np.where(valid, 1.0 / np.maximum(np.where(valid, variance, 1.0), 1e-18), 0.0)
    kept = covariance if independent is None else independent
    value = np.empty_like(raw)
    spread = np.empty_like(kept)

    def work(start: int, stop: int) -> None:
        _average_rows(start, stop, labels, raw, kept, weight, radius, value, spread)

    in_row_blocks(work, labels.shape[0], threads)
    return value, spread
