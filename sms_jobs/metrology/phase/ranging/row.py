"""A row of pixels: what was read of it, what is known of its returns, and how that becomes maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.compilation import inner, kernel
from sms_jobs.metrology.phase.ranging.plan import Plan, freedom
from sms_jobs.metrology.phase.ranging.reference_fit import AMPLITUDE, COLUMNS, OMEGA, SPREAD, VARIANCE
from sms_jobs.metrology.phase.ranging.transform import wrapped


class Maps(NamedTuple):
    """The fields of `Returns`, which see, in its order, as they are filled row by row."""

    omega: Floats
    omega_sigma: Singles
    amplitude: Singles
    width: Singles
    returns: NDArray[np.uint8]
    residual: Singles
    mean_intensity: Singles
    modulation: Singles
    saturated: Mask


class Row(NamedTuple):
    """A row of pixels.

    Attributes
    ----------
    signal
        z, (2, densities, columns), real and imaginary part, 0 where a density is left out.
    lost
        (densities + 1, columns): 1 where a density is left out; in the last row how many are.
    levels
        (2, columns): mean of all frames, and the rms of B over t.
    variance
        Of z, (columns,).
    estimates
        (columns, returns, 4), columns of `reference_fit`: the returns that are known.
    returns
        (columns,): how many of them there are.
    squares
        (columns,): the weighted sum of squares of what they leave.
    resolved
        (columns,): False where there may be more of them.
    """

    signal: Singles
    lost: NDArray[np.uint8]
    levels: Singles
    variance: Floats
    estimates: Floats
    returns: Ints
    squares: Floats
    resolved: Mask


def new_maps(returns: int, rows: int, columns: int) -> Maps:
    """Return room for the maps of an image."""
    several, one = (returns, rows, columns), (rows, columns)
    return Maps(
        np.empty(several),
        np.empty(several, np.float32),
        np.empty(several, np.float32),
        np.empty(several, np.float32),
        np.empty(one, np.uint8),
        np.empty(one, np.float32),
        np.empty(one, np.float32),
        np.empty(one, np.float32),
        np.empty(one, np.bool_),
    )


def new_row(returns: int, densities: int, columns: int) -> Row:
    """Return room for a row."""
    return Row(
        np.empty((2, densities, columns), np.float32),
        np.empty((densities + 1, columns), np.uint8),
        np.empty((2, columns), np.float32),
        np.empty(columns),
        np.empty((columns, returns, COLUMNS)),
        np.empty(columns, np.int64),
        np.empty(columns),
        np.empty(columns, np.bool_),
    )


@inner
@kernel
def begin_row(plan: Plan, row: Row) -> None:
    """Take nothing of the pixels of a row for known but the variance of their signal."""
    row.returns[:] = 0
    row.resolved[:] = False
    for column in range(row.returns.size):
        row.variance[column] = plan.variance + plan.slope * row.levels[0, column]


@inner
@kernel
def write_row(plan: Plan, row: Row, maps: Maps, index: int) -> None:
    """Write the pixels of a row to the maps, strongest return first, NaN where there is no further one."""
    omega, sigma, amplitude, width = maps.omega, maps.omega_sigma, maps.amplitude, maps.width
    estimates, most = row.estimates, maps.omega.shape[0]
    for column in range(row.returns.size):
        count, variance = row.returns[column], row.variance[column]
        for i in range(count):
            mine, rank = estimates[column, i, AMPLITUDE], 0
            for k in range(count):
                other = estimates[column, k, AMPLITUDE]
                rank += 1 if other > mine or (other == mine and k < i) else 0
            omega[rank, index, column] = wrapped(estimates[column, i, OMEGA])
            sigma[rank, index, column] = np.sqrt(variance * estimates[column, i, VARIANCE])
            amplitude[rank, index, column] = mine
            width[rank, index, column] = np.sqrt(max(estimates[column, i, SPREAD], 0.0))
        for rank in range(count, most):
            omega[rank, index, column] = np.nan
            sigma[rank, index, column] = np.nan
            amplitude[rank, index, column] = np.nan
            width[rank, index, column] = np.nan
    count_map, residual, saturated = maps.returns, maps.residual, maps.saturated
    densities = row.lost.shape[0] - 1
    for column in range(row.returns.size):
        count, lost = row.returns[column], row.lost[densities, column]
        free = freedom(plan.first, densities - lost, count)
        squares = row.squares[column] if count > 0 and free > 0.0 else np.nan
        count_map[index, column] = count
        residual[index, column] = plan.unit * np.sqrt(squares / free)
        saturated[index, column] = densities - lost < plan.least
    maps.mean_intensity[index] = row.levels[0]
    maps.modulation[index] = row.levels[1]
