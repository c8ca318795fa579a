"""The returns of the pixels of a row that are not resolved in batches: one after the other, fitted jointly.

For each return: find the highest peak of what the known ones leave, fit all of them from there, and test what
that gains. Peaks are searched for in `LANES` pixels at a time; the fits are those of `reference_fit`.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.compilation import inlined, inner, kernel
from sms_jobs.metrology.phase.ranging.plan import CLOSE_BINS, Plan, freedom, may_hold_another
from sms_jobs.metrology.phase.ranging.reference_fit import (
    AMPLITUDE,
    COLUMNS,
    OMEGA,
    Fit,
    copy_estimates,
    fit_returns,
    new_fit,
    power,
    subtract,
    write_spread,
)
from sms_jobs.metrology.phase.ranging.row import Row
from sms_jobs.metrology.phase.ranging.transform import LANES, Peaks, find_peaks, new_peaks, wrapped
from sms_jobs.metrology.phase.ranging.weights import Sums, Weights, leave_out, new_weights, sums_of

_SPLIT_BINS = 0.3  # to either side


class Pixel(NamedTuple):
    """One pixel for the fit: its signal (2, padded), weights with their sums, its noise, its freedom."""

    z: Singles
    weights: Weights
    sums: Sums
    variance: float
    values: float


class Buffers(NamedTuple):
    """What `LANES` pixels are searched with.

    Attributes
    ----------
    x, y
        What is left of their signals, (densities, LANES).
    z
        Their signals, (LANES, 2, padded).
    kept
        Its weights without the densities that are left out.
    column, searched
        (LANES,): where they are, and whether they may have more returns.
    first_gain
        (LANES,): by what the first return lowers the sum of squares.
    start, best
        Estimates of a fit, (returns, 4).
    """

    x: Singles
    y: Singles
    peaks: Peaks
    z: Singles
    kept: Weights
    column: Ints
    searched: Mask
    first_gain: Floats
    start: Floats
    best: Floats
    fit: Fit


@inner
@kernel
def _new_buffers(plan: Plan, returns: int) -> Buffers:
    padded = plan.weights.search.size
    return Buffers(
        np.zeros((plan.densities, LANES), np.float32),
        np.zeros((plan.densities, LANES), np.float32),
        new_peaks(plan.transform.order.size),
        np.zeros((LANES, 2, padded), np.float32),
        new_weights(padded),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES),
        np.zeros((returns, COLUMNS)),
        np.zeros((returns, COLUMNS)),
        new_fit(returns, padded),
    )


@inner
@kernel
def _load(row: Row, lanes: int, buffers: Buffers) -> None:
    """Take the signals of some pixels from their row."""
    signal, z = row.signal, buffers.z
    for t in range(signal.shape[1]):  # in the order in which a row lies in memory
        for j in range(lanes):
            z[j, 0, t] = signal[0, t, buffers.column[j]]
            z[j, 1, t] = signal[1, t, buffers.column[j]]


@inlined
def _pixel(plan: Plan, row: Row, j: int, buffers: Buffers) -> Pixel:
    """Return the pixel of a lane; its weights hold until the next one is asked for."""
    column = buffers.column[j]
    missing = row.lost[plan.densities, column]
    weights, sums = plan.weights, plan.sums
    if missing > 0:
        leave_out(plan.weights, row.lost[: plan.densities, column], buffers.kept)
        weights, sums = buffers.kept, sums_of(buffers.kept, plan.first)
    values = freedom(plan.first, plan.densities - missing, int(np.int64(0)))
    return Pixel(buffers.z[j], weights, sums, row.variance[column], values)


@inlined
def _nearest(omega: float, estimates: Floats) -> int:
    """Return which return is nearest to an omega."""
    nearest = 0
    for i in range(1, len(estimates)):
        if abs(wrapped(estimates[i, OMEGA] - omega)) < abs(wrapped(estimates[nearest, OMEGA] - omega)):
            nearest = i
    return nearest


@inlined
def _all_positive(estimates: Floats) -> bool:
    """Tell whether all amplitudes are positive."""
    lowest = np.inf
    for i in range(len(estimates)):
        lowest = min(lowest, estimates[i, AMPLITUDE])
    return bool(lowest > 0.0)


@inlined
def _fit_with_another(plan: Plan, pixel: Pixel, omega: float, estimates: Floats, buffers: Buffers) -> float:
    """Fit the returns of a pixel, of which the last is new and near `omega`, from the better of two starts.

    The fit starts from the peak of what the others leave. Two returns within half a bin are one peak, and
    leave one that is at neither; near a return the fit also starts from that return split in two. Returns the
    weighted sum of squares, infinite where a return is not positive; the estimates and what they leave are in
    `buffers.best` and `buffers.fit`.
    """
    known, start, best = len(estimates) - 1, buffers.start[: len(estimates)], buffers.best[: len(estimates)]
    one_bin = 2.0 * pi / plan.sums.transfer
    nearest = _nearest(omega, estimates[:known])
    centre = estimates[nearest, OMEGA]
    close = known > 0 and abs(wrapped(centre - omega)) < CLOSE_BINS * one_bin
    lowest, squares = np.inf, np.inf
    for attempt in range(2 if close else 1):
        copy_estimates(estimates, start, known)
        start[known, OMEGA] = omega
        if close and attempt == 0:
            start[nearest, OMEGA] = centre - _SPLIT_BINS * one_bin
            start[known, OMEGA] = centre + _SPLIT_BINS * one_bin
        squares = fit_returns(
            pixel.z, pixel.weights, pixel.sums, plan.first, pixel.variance, start, buffers.fit
        )
        if _all_positive(start) and squares < lowest:
            lowest = squares
            copy_estimates(start, best, known + 1)
    if squares > lowest:
        lowest = fit_returns(
            pixel.z, pixel.weights, pixel.sums, plan.first, pixel.variance, best, buffers.fit
        )
    return lowest


@inlined
def _add_return(plan: Plan, pixel: Pixel, row: Row, j: int, count: int, buffers: Buffers) -> bool:
    """Add a return to the `count` of a pixel if it is significant; what is left then is put into its lane.

    The first return is tested last of all: a strong second one would count as its noise.
    """
    column, n = buffers.column[j], count + 1
    estimates, squares = row.estimates[column, :n], row.squares[column]
    lowest = _fit_with_another(plan, pixel, buffers.peaks.omega[j], estimates, buffers)
    values = pixel.values - 2.0 * n if count > 0 else np.inf
    floor = max(pixel.variance, lowest / max(values, 1.0))
    if not squares - lowest > plan.threshold * plan.threshold * floor:
        return False
    copy_estimates(buffers.best, estimates, n)
    write_spread(pixel.weights, pixel.sums, estimates, buffers.fit)
    row.returns[column], row.squares[column] = n, lowest
    if count == 0:
        buffers.first_gain[j] = squares - lowest
    _leave(buffers.fit.residual, j, buffers)
    return True


@inlined
def _leave(residual: Singles, j: int, buffers: Buffers) -> None:
    """Put what is left of a pixel into its lane."""
    for t in range(buffers.x.shape[0]):
        buffers.x[t, j] = residual[0, t]
        buffers.y[t, j] = residual[1, t]


@inner
@kernel
def _begin(plan: Plan, row: Row, lanes: int, buffers: Buffers) -> None:
    """Begin the search of some pixels with what their known returns leave."""
    _load(row, lanes, buffers)
    buffers.searched[:] = False
    buffers.first_gain[:] = np.inf
    for j in range(lanes):
        column = buffers.column[j]
        pixel = _pixel(plan, row, j, buffers)
        count = row.returns[column]
        buffers.searched[j] = plan.densities - row.lost[plan.densities, column] >= plan.least
        if count == 0:
            row.squares[column] = power(pixel.z, pixel.weights.precision)
        subtract(pixel.z, pixel.weights.transfer, plan.first, row.estimates[column, :count], buffers.fit)
        _leave(buffers.fit.residual, j, buffers)


@inner
@kernel
def _search(plan: Plan, row: Row, lanes: int, buffers: Buffers) -> None:
    """Search some pixels for returns until none of them has a further one."""
    most = row.estimates.shape[1]
    for count in range(most):
        if not buffers.searched.any():
            break
        find_peaks(buffers.x, buffers.y, plan.weights.search, plan.first, plan.transform, buffers.peaks)
        for j in range(lanes):
            column = buffers.column[j]
            if not buffers.searched[j] or row.returns[column] > count:
                continue
            pixel = _pixel(plan, row, j, buffers)
            score = buffers.peaks.height[j] / np.sqrt(pixel.sums.search_noise)
            free = pixel.values - 2.0 * count
            buffers.searched[j] = (
                count == 0
                or may_hold_another(plan.threshold, free, pixel.variance, row.squares[column], score)
            ) and _add_return(plan, pixel, row, j, count, buffers)
    for j in range(lanes):
        column = buffers.column[j]
        free = freedom(plan.first, plan.densities - row.lost[plan.densities, column], row.returns[column])
        floor = max(row.variance[column], row.squares[column] / max(free, 1.0))
        if not buffers.first_gain[j] > plan.threshold * plan.threshold * floor:
            row.returns[column] = 0


@inner
@kernel
def search_row(plan: Plan, row: Row, begin: int, end: int) -> None:
    """Find the further returns of the pixels that are not resolved, columns `begin` to `end`; write them."""
    if row.resolved[begin:end].all():
        return
    buffers = _new_buffers(plan, row.estimates.shape[1])
    lanes = 0
    for column in range(begin, end):
        if not row.resolved[column]:
            buffers.column[lanes] = column
            lanes += 1
        if lanes == LANES or (lanes > 0 and column == end - 1):
            _begin(plan, row, lanes, buffers)
            _search(plan, row, lanes, buffers)
            lanes = 0
