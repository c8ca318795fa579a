"""Star images: a displacement whose period falls along the image, what is left of it, and theory.

The displacement is that of the star of the DIC Challenge 2.0 (Reu et al. 2022): along the rows' direction,
a cosine of 0.5 px across the middle row, with a period that grows linearly along the columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.correlated.lone_camera import FULL_SCALE
from sms_jobs.bench.correlated.speckle_pairs import speckle_pair
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.fields.spatial_resolution import KEPT, resolution_of

ROWS, COLUMNS = 501, 2000
MIDDLE = ROWS // 2
AMPLITUDE_PX = 0.5
SHORTEST_PX, LONGEST_PX = 10.0, 300.0
CONTRAST, NOISE = 250.0, 12.5
"""Standard deviations of speckle and of noise, in grey levels of 12 bits."""
_STRAIGHT = 1.5
"""Periods from the middle row within which the star's waves run along the columns; farther off they are
oblique, and shorter than their column's period."""
_NEAR = 0.82, 0.97
"""What has to be left of the amplitude for a column to tell where `KEPT` is."""
_SMOOTHED = 25


@dataclass(frozen=True)
class Star:
    """Recorded images of 12 bits, (rows, columns).

    Attributes
    ----------
    reference, still
        Two recordings of the specimen at rest.
    deformed
        One of the star.
    exact
        The reference without noise.
    """

    reference: NDArray[np.uint16]
    still: NDArray[np.uint16]
    deformed: NDArray[np.uint16]
    exact: Floats


def period_at(column: Floats) -> Floats:
    """Return the period in px at columns of the image."""
    return SHORTEST_PX + (LONGEST_PX - SHORTEST_PX) * column / COLUMNS


def star(seed: int) -> Star:
    """Render a star with speckle and noise of a seed; each grey level is exact but for noise and rounding."""

    def displacement(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        period = period_at(np.clip(x, 0.0, COLUMNS))
        return np.zeros_like(x), AMPLITUDE_PX * np.cos(2.0 * np.pi * (y - MIDDLE) / period)

    exact, moved = speckle_pair((ROWS, COLUMNS), displacement, seed, CONTRAST)
    rng = np.random.default_rng(seed + 1_000_003)

    def recorded(light: Floats) -> NDArray[np.uint16]:
        return np.rint(light + rng.normal(0.0, NOISE, light.shape)).clip(0, FULL_SCALE).astype(np.uint16)

    return Star(recorded(exact), recorded(exact), recorded(moved), exact)


def amplitudes(v: Floats, rows: Floats, periods: Floats) -> Floats:
    """Return what each column has of the amplitude, as a part of it.

    Parameters
    ----------
    v
        (rows, columns) in px, NaN where there is none.
    rows
        (rows,), distance from the middle row in px.
    periods
        (columns,) in px.

    Returns
    -------
    (columns,), by least squares of a cosine and a constant over the rows within one and a half periods of the
    middle; NaN for a column of which a fifth of these or more is missing.
    """
    found = np.full(len(periods), np.nan)
    for k, period in enumerate(periods):
        straight = np.abs(rows) <= _STRAIGHT * period
        known = np.isfinite(v[:, k]) & straight
        if known.sum() > 0.8 * straight.sum():
            basis = np.stack([np.cos(2.0 * np.pi * rows[known] / period), np.ones(known.sum())], axis=1)
            found[k] = np.linalg.lstsq(basis, v[known, k], rcond=None)[0][0] / AMPLITUDE_PX
    return found


def resolution(periods: Floats, kept: Floats) -> float:
    """Return the period at which `KEPT` of the amplitude is left, in px; NaN where that is not crossed.

    The columns about the crossing are fitted by a parabola of the logarithm of the period.
    """
    known = np.isfinite(kept)
    period, part = np.log(periods[known]), kept[known]
    if len(part) < _SMOOTHED:
        return float("nan")
    smooth = np.convolve(np.pad(part, _SMOOTHED // 2, mode="edge"), np.ones(_SMOOTHED) / _SMOOTHED, "valid")
    below = np.flatnonzero(smooth < KEPT)
    if not len(below) or below[-1] == len(part) - 1:
        return float("nan")
    near = (smooth > _NEAR[0]) & (smooth < _NEAR[1]) & (np.abs(period - period[below[-1]]) < 0.5)
    middle = period[below[-1]]
    fit = np.polynomial.Polynomial.fit(period[near] - middle, part[near], 2)
    roots = (fit - KEPT).roots()
    real = roots[np.isreal(roots)].real
    return float(np.exp(middle + real[np.argmin(np.abs(real))])) if len(real) else float("nan")


def centre_weights(side: int, order: int) -> Floats:
    """Return what a subset's pixels, (side, side), contribute to its centre by a polynomial of an order.

    Notes
    -----
    Least squares of a polynomial in x and y over the square, at its centre: the filter of Savitzky and Golay
    (1964) in two dimensions, which is what a shape function does to a displacement that it cannot follow
    where the texture is alike everywhere (Schreier and Sutton 2002).
    """
    y, x = (np.mgrid[0:side, 0:side] - (side - 1) / 2.0).reshape(2, -1)
    terms = [x**a * y**b for a in range(order + 1) for b in range(order + 1 - a)]
    weights: Floats = np.linalg.pinv(np.stack(terms, axis=1).astype(np.float64))[0].reshape(side, side)
    return weights


def transfer(side: int, order: int, periods: Floats) -> Floats:
    """Return what a subset leaves of the amplitude of a cosine along the rows' direction, by theory."""
    along = centre_weights(side, order).sum(axis=1)
    place = np.arange(side) - (side - 1) / 2.0
    return np.asarray(np.cos(2.0 * np.pi * place / periods[:, None]) @ along)


def expected_resolution(side: int, order: int) -> float:
    """Return the period in px at which nine tenths are left of a match alone, by theory: the longest such."""
    periods = np.linspace(2.0, 20.0 * side, 200_000 // side)
    return resolution_of(periods, transfer(side, order, periods))


def noise_gain(side: int, order: int) -> float:
    """Return by what an order's noise at the centre is above that of a shift alone, by theory."""
    return float(side * np.sqrt(np.sum(centre_weights(side, order) ** 2)))
