"""The pixels of a row that are settled many at a time: those with one return, or two well apart.

Whatever is not plain here (lost densities, close returns, three of them, slow convergence) is left open for
`returns_search`, with the first return where it is known.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.phase import returns_lanes, returns_pairs
from sms_jobs.metrology.phase.returns_fit import (
    AMPLITUDE,
    COS,
    OMEGA,
    SEARCH,
    SIN,
    SPREAD,
    VARIANCE,
    VT4,
    VTT,
    G,
    N,
    V,
)
from sms_jobs.metrology.phase.returns_lanes import FALL, FAST, GROUP, SQUARES, STEP_TIMES_S, fit_one_each
from sms_jobs.metrology.phase.returns_of_pixel import (
    CLOSE,
    height_of_real_peak,
    start_of_real_peak,
    wrapped,
)
from sms_jobs.metrology.phase.returns_pairs import fit_two_each, is_done
from sms_jobs.metrology.phase.returns_plan import Plan, is_worth_a_fit, real_values
from sms_jobs.metrology.phase.returns_transform import LANES, real_peaks

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

_FEW = 6  # pixels of a chunk that are fitted one by one at less cost than all of them together

_OPEN, _ONE, _TWO = -1, 1, 2  # what a pixel is settled to, 0 for no return; _OPEN where it is not


class _Chunk(NamedTuple):
    """Buffers of a chunk of pixels: signal, transform, and states of `returns_lanes` and `returns_pairs`."""

    x: Single
    y: Single
    spectrum: Single
    best: Single
    where: NDArray[np.int32]
    one: Floats
    pair: Floats
    rotors: Single
    fast: Single
    wanted: NDArray[np.bool_]
    settled: NDArray[np.int64]
    known: NDArray[np.bool_]
    variance: Floats


@kernel
def _chunk(plan: Plan, count: int) -> _Chunk:
    """Return the buffers of a chunk."""
    rows = (count + GROUP - 1) // GROUP * GROUP
    return _Chunk(
        np.zeros((rows, LANES), np.float32),
        np.zeros((rows, LANES), np.float32),
        np.empty((2, plan.order.size, LANES), np.float32),
        np.empty(LANES, np.float32),
        np.empty(LANES, np.int32),
        np.zeros(returns_lanes.SIZE),
        np.zeros(returns_pairs.PAIR_SIZE),
        np.zeros((plan.weights.shape[1], LANES), np.float32),
        np.zeros(2 * FAST, np.float32),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES),
    )


@kernel
def _load(signal: Single, start: int, lanes: int, x: Single, y: Single) -> None:
    """Take the pixels from column `start` on."""
    for t in range(signal.shape[1]):
        for j in range(lanes):
            # An unsigned index needs no look at its sign, which would keep this from being a vector copy.
            x[t, j] = signal[0, t, np.uint64(start + j)]
            y[t, j] = signal[1, t, np.uint64(start + j)]


@kernel
def _find_peaks(plan: Plan, chunk: _Chunk) -> None:
    real_peaks(
        chunk.x,
        chunk.y,
        plan.weights[SEARCH],
        plan.first,
        plan.turns,
        plan.order,
        chunk.spectrum,
        chunk.best,
        chunk.where,
    )


@kernel
def _settle_ones(plan: Plan, count: int, chunk: _Chunk) -> None:
    """Fit one return to all pixels of a chunk; settled are those whose last step was small.

    Small is also what is small against its own standard deviation. `x` and `y` become what is left.
    """
    one = chunk.one
    for j in range(LANES):
        one[returns_lanes.OMEGA + j] = start_of_real_peak(chunk.spectrum, chunk.where[j], j)
    fit_one_each(chunk.x, chunk.y, count, plan.weights, plan.sums, plan.first, one, chunk.rotors, chunk.fast)
    v, vtt = plan.sums[V], plan.sums[VTT]
    free = real_values(plan.first, count) - 2.0
    square = plan.threshold * plan.threshold
    for j in range(LANES):
        a = one[returns_lanes.AMPLITUDE + j]
        floor = max(chunk.variance[j], one[SQUARES + j] / free)
        width = count * np.sqrt(floor / (a * a * vtt))
        step = abs(one[STEP_TIMES_S + j])
        small = step < max(returns_lanes.SMALL, min(4.0 * width, 4.0 * returns_lanes.SMALL))
        chunk.known[j] = small and a > 0.0 and a * a * v > square * floor
        if small:
            chunk.settled[j] = _ONE if chunk.known[j] else 0


@kernel
def _want_pairs(plan: Plan, count: int, chunk: _Chunk) -> int:
    """Start the fit of two returns where one leaves enough for another; return in how many pixels.

    Pixels whose second return is close to the first are opened again.
    """
    free = real_values(plan.first, count) - 2.0
    scale = 0.0
    for t in range(count):
        scale += plan.weights[SEARCH, t] * plan.weights[G, t]
    wanted = 0
    for j in range(LANES):
        omega = chunk.one[returns_lanes.OMEGA + j]
        chunk.wanted[j] = False
        second, height = omega + 2.0, 0.0
        if chunk.settled[j] == _ONE:
            height = height_of_real_peak(chunk.spectrum, chunk.where[j], j)
            if is_worth_a_fit(
                plan.threshold, free, chunk.variance[j], chunk.one[SQUARES + j], plan.sums[N], height
            ):
                second = start_of_real_peak(chunk.spectrum, chunk.where[j], j)
                chunk.wanted[j] = abs(wrapped(second - omega)) > CLOSE * 2.0 * pi / count
                chunk.settled[j] = _ONE if chunk.wanted[j] else _OPEN
        wanted += 1 if chunk.wanted[j] else 0
        chunk.pair[returns_lanes.OMEGA + j] = omega
        chunk.pair[returns_lanes.AMPLITUDE + j] = chunk.one[returns_lanes.AMPLITUDE + j]
        chunk.pair[returns_lanes.SIZE + returns_lanes.OMEGA + j] = second
        chunk.pair[returns_lanes.SIZE + returns_lanes.AMPLITUDE + j] = max(height, 0.0) / scale
    return wanted


@kernel
def _settle_pairs(plan: Plan, count: int, chunk: _Chunk) -> int:
    """Fit two returns to the wanted pixels; settled are those that converged. Return how many have two."""
    pair = chunk.pair
    fit_two_each(
        chunk.x,
        chunk.y,
        count,
        plan.weights,
        plan.sums,
        plan.overlaps,
        plan.first,
        chunk.wanted,
        chunk.variance,
        pair,
        chunk.rotors,
        chunk.fast,
    )
    free = real_values(plan.first, count) - 4.0
    found = 0
    for j in range(LANES):
        if not chunk.wanted[j]:
            continue
        first, second = pair[returns_lanes.OMEGA + j], pair[returns_lanes.SIZE + returns_lanes.OMEGA + j]
        least = min(pair[returns_lanes.AMPLITUDE + j], pair[returns_lanes.SIZE + returns_lanes.AMPLITUDE + j])
        gained = chunk.one[SQUARES + j] - pair[SQUARES + j]
        floor = max(chunk.variance[j], pair[SQUARES + j] / max(free, 1.0))
        chunk.settled[j] = _OPEN
        if (
            least > 0.0
            and abs(wrapped(second - first)) > CLOSE * 2.0 * pi / count
            and is_done(pair[STEP_TIMES_S + j], pair[returns_pairs.GAIN + j], chunk.variance[j])
        ):
            chunk.settled[j] = _TWO if gained > plan.threshold * plan.threshold * floor else _ONE
            found += 1 if chunk.settled[j] == _TWO else 0
    return found


@kernel
def _open_thirds(plan: Plan, count: int, chunk: _Chunk) -> None:
    """Open the pixels again in which two returns leave enough for a third."""
    _find_peaks(plan, chunk)
    free = real_values(plan.first, count) - 4.0
    for j in range(LANES):
        if chunk.settled[j] == _TWO and is_worth_a_fit(
            plan.threshold,
            free,
            chunk.variance[j],
            chunk.pair[SQUARES + j],
            plan.sums[N],
            height_of_real_peak(chunk.spectrum, chunk.where[j], j),
        ):
            chunk.settled[j] = _OPEN


@kernel
def _settle(plan: Plan, signal: Single, start: int, lanes: int, most: int, chunk: _Chunk) -> None:
    """Settle what can be settled of a chunk."""
    count = signal.shape[1]
    _load(signal, start, lanes, chunk.x, chunk.y)
    _find_peaks(plan, chunk)
    _settle_ones(plan, count, chunk)
    if most == 1:
        return
    _find_peaks(plan, chunk)
    wanted = _want_pairs(plan, count, chunk)
    if wanted > _FEW:
        _load(signal, start, lanes, chunk.x, chunk.y)
        if _settle_pairs(plan, count, chunk) > 0 and most > 2:
            _open_thirds(plan, count, chunk)
    elif wanted > 0:
        for j in range(LANES):
            if chunk.wanted[j]:
                chunk.settled[j] = _OPEN


@kernel
def _report(
    rank: int,
    lever: float,
    cofactor: float,
    state: Floats,
    o: int,
    j: int,
    row: int,
    column: int,
    omega: Floats,
    maps: Single,
) -> None:
    """Write a return, whose state begins at o, of pixel j; `cofactor` is the variance of a omega."""
    a = state[o + returns_lanes.AMPLITUDE + j]
    omega[rank, row, column] = wrapped(state[o + returns_lanes.OMEGA + j])
    maps[0, rank, row, column] = np.sqrt(cofactor) / a
    maps[1, rank, row, column] = a
    maps[2, rank, row, column] = np.sqrt(max(-2.0 * state[o + FALL + j] / (a * lever), 0.0))


@kernel
def _report_pixel(
    plan: Plan, chunk: _Chunk, j: int, row: int, column: int, omega: Floats, maps: Single
) -> float:
    """Write the returns of a settled pixel, strongest first, NaN beyond; return what they leave."""
    found = chunk.settled[j]
    for i in range(found, omega.shape[0]):
        omega[i, row, column] = np.nan
        for k in range(3):
            maps[k, i, row, column] = np.nan
    v, vtt = plan.sums[V], plan.sums[VTT]
    lever = plan.sums[VT4] - vtt * vtt / v
    if found == _ONE:
        _report(0, lever, chunk.variance[j] / vtt, chunk.one, 0, j, row, column, omega, maps)
        return float(chunk.one[SQUARES + j])
    if found == _TWO:
        pair, size = chunk.pair, returns_lanes.SIZE
        a, b = pair[returns_lanes.AMPLITUDE + j], pair[size + returns_lanes.AMPLITUDE + j]
        cofactor = chunk.variance[j] * pair[returns_pairs.VARIANCE + j]
        _report(0, lever, cofactor, pair, 0 if a >= b else size, j, row, column, omega, maps)
        _report(1, lever, cofactor, pair, size if a >= b else 0, j, row, column, omega, maps)
        return float(pair[SQUARES + j])
    return np.nan


@kernel
def _hand_over(plan: Plan, chunk: _Chunk, j: int, column: int, known: Floats) -> None:
    """Write the first return of an open pixel for `returns_search`."""
    one = chunk.one
    a, omega = one[returns_lanes.AMPLITUDE + j], one[returns_lanes.OMEGA + j]
    v, vtt = plan.sums[V], plan.sums[VTT]
    known[OMEGA, column] = omega
    known[COS, column] = np.cos(omega)
    known[SIN, column] = np.sin(omega)
    known[AMPLITUDE, column] = a
    known[VARIANCE, column] = 1.0 / (a * a * vtt)
    known[SPREAD, column] = -2.0 * one[FALL + j] / (a * (plan.sums[VT4] - vtt * vtt / v))
    known[SPREAD + 1, column] = one[SQUARES + j]


@kernel
def settle_row(
    plan: Plan,
    signal: Single,
    lost: NDArray[np.uint8],
    row: int,
    omega: Floats,
    maps: Single,
    planes: Single,
    flags: NDArray[np.uint8],
    opened: NDArray[np.int64],
    known: Floats,
) -> int:
    """Find the returns of the plain pixels of one row.

    Parameters
    ----------
    opened
        (columns,), the first become the columns of the pixels that are not settled, whose number is returned.
    known
        (7, columns), becomes the first return of these pixels: the rows of a state and the weighted sum of
        squares that it leaves; the amplitude is 0 where it is not known.

    The other parameters are those of `returns_search.find_jointly`; those of settled pixels are written.
    """
    count, columns = signal.shape[1], signal.shape[2]
    chunk = _chunk(plan, count)
    still = 0
    for start in range(0, columns, LANES):
        lanes = min(LANES, columns - start)
        for j in range(LANES):
            chunk.settled[j] = _OPEN
            chunk.variance[j] = plan.variance + plan.slope * planes[0, row, start + j] if j < lanes else 1.0
        _settle(plan, signal, start, lanes, omega.shape[0], chunk)
        for j in range(lanes):
            if lost[count, start + j] > 0 or chunk.settled[j] == _OPEN:
                opened[still] = start + j
                still += 1
                known[AMPLITUDE, start + j] = 0.0
                if chunk.known[j] and lost[count, start + j] == 0:
                    _hand_over(plan, chunk, j, start + j, known)
                continue
            squares = _report_pixel(plan, chunk, j, row, start + j, omega, maps)
            flags[0, row, start + j] = chunk.settled[j]
            flags[1, row, start + j] = 0
            free = real_values(plan.first, count) - 2.0 * chunk.settled[j]
            planes[2, row, start + j] = plan.unit * np.sqrt(squares / free) if free > 0.0 else np.nan
    return still
