"""A chunk of `LANES` pixels of a row: its buffers, and what is read into and written from them."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.phase.ranging import one_each, two_each
from sms_jobs.metrology.phase.ranging.fit import (
    AMPLITUDE,
    COS,
    OMEGA,
    SEARCH,
    SIN,
    SPREAD,
    VARIANCE,
    VT4,
    VTT,
    V,
    inlined,
)
from sms_jobs.metrology.phase.ranging.of_pixel import wrapped
from sms_jobs.metrology.phase.ranging.one_each import FALL, FAST, GROUP, SQUARES
from sms_jobs.metrology.phase.ranging.plan import Plan, real_values
from sms_jobs.metrology.phase.ranging.transform import LANES, real_peaks

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

# What a pixel is settled to, 0 for no return; OPEN where it is not, LATER where it waits for others like it.
OPEN, LATER, ONE, TWO = -1, -2, 1, 2


class Chunk(NamedTuple):
    """Buffers of a chunk of pixels: signal, transform, and states of `one_each` and `two_each`."""

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
    near: NDArray[np.bool_]
    column: NDArray[np.int64]


@kernel
def new_chunk(plan: Plan, count: int) -> Chunk:
    """Return the buffers of a chunk."""
    rows = (count + GROUP - 1) // GROUP * GROUP
    return Chunk(
        np.zeros((rows, LANES), np.float32),
        np.zeros((rows, LANES), np.float32),
        np.empty((2, plan.order.size, LANES), np.float32),
        np.empty(LANES, np.float32),
        np.empty(LANES, np.int32),
        np.zeros(one_each.SIZE),
        np.zeros(two_each.PAIR_SIZE),
        np.zeros((plan.weights.shape[1], LANES), np.float32),
        np.zeros(2 * FAST, np.float32),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.int64),
    )


@kernel
def beside(chunk: Chunk) -> Chunk:
    """Return the buffers of another chunk, which shares its scratch with the first.

    Each row makes its chunks anew: what the heap does not keep from row to row would cost more than it holds.
    """
    return Chunk(
        np.zeros_like(chunk.x),
        np.zeros_like(chunk.y),
        chunk.spectrum,
        chunk.best,
        chunk.where,
        np.zeros_like(chunk.one),
        np.zeros_like(chunk.pair),
        chunk.rotors,
        chunk.fast,
        chunk.wanted,
        np.zeros_like(chunk.settled),
        np.zeros_like(chunk.known),
        np.zeros_like(chunk.variance),
        np.zeros_like(chunk.near),
        np.zeros_like(chunk.column),
    )


@kernel
def load(signal: Single, start: int, lanes: int, x: Single, y: Single) -> None:
    """Take the pixels from column `start` on."""
    for t in range(signal.shape[1]):
        for j in range(lanes):
            # An unsigned index needs no look at its sign, which would keep this from being a vector copy.
            x[t, j] = signal[0, t, np.uint64(start + j)]
            y[t, j] = signal[1, t, np.uint64(start + j)]


@kernel
def collect(
    signal: Single, source: Chunk, start: int, lanes: int, target: Chunk, filled: int
) -> tuple[int, int]:
    """Move pixels that wait, from lane `start` on, to the next free lanes of another chunk.

    Their signal is taken as it was read. Returns the lane from which on pixels are still to be moved, since
    the other chunk was full, and the number of lanes that are filled there.
    """
    settled, column, one, pair = source.settled, source.column, source.one, source.pair
    x, y, to_one, to_pair, to_column = target.x, target.y, target.one, target.pair, target.column
    k = filled
    for j in range(start, lanes):
        if settled[j] != LATER:
            continue
        if k == LANES:
            return j, k
        for t in range(signal.shape[1]):
            x[t, k] = signal[0, t, column[j]]
            y[t, k] = signal[1, t, column[j]]
        for part in range(0, one.size, LANES):
            to_one[part + k] = one[part + j]
        for part in range(0, pair.size, LANES):
            to_pair[part + k] = pair[part + j]
        to_column[k] = column[j]
        target.known[k] = source.known[j]
        target.variance[k] = source.variance[j]
        target.near[k] = source.near[j]
        k += 1
    return lanes, k


@kernel
def find_peaks(plan: Plan, chunk: Chunk) -> None:
    """Transform what `x` and `y` hold, and find the highest sample of every pixel."""
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


@inlined
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
    a = state[o + one_each.AMPLITUDE + j]
    omega[rank, row, column] = wrapped(state[o + one_each.OMEGA + j])
    maps[0, rank, row, column] = np.sqrt(cofactor) / a
    maps[1, rank, row, column] = a
    maps[2, rank, row, column] = np.sqrt(max(-2.0 * state[o + FALL + j] / (a * lever), 0.0))


@kernel
def report(
    plan: Plan,
    chunk: Chunk,
    count: int,
    lanes: int,
    row: int,
    omega: Floats,
    maps: Single,
    planes: Single,
    flags: NDArray[np.uint8],
) -> None:
    """Write the returns of the settled pixels, strongest first, NaN beyond, and what they leave."""
    v, vtt = plan.sums[V], plan.sums[VTT]
    lever = plan.sums[VT4] - vtt * vtt / v
    one, pair, settled, variance = chunk.one, chunk.pair, chunk.settled, chunk.variance
    places, size, first, unit = chunk.column, one_each.SIZE, plan.first, plan.unit
    for j in range(lanes):
        found, column = settled[j], places[j]
        if found < 0:
            continue
        for i in range(found, omega.shape[0]):
            omega[i, row, column] = np.nan
            for k in range(3):
                maps[k, i, row, column] = np.nan
        squares = np.nan
        if found == ONE:
            squares = one[SQUARES + j]
            _report(0, lever, variance[j] / vtt, one, 0, j, row, column, omega, maps)
        if found == TWO:
            squares = pair[SQUARES + j]
            stronger = pair[one_each.AMPLITUDE + j] >= pair[size + one_each.AMPLITUDE + j]
            cofactor = variance[j] * pair[two_each.VARIANCE + j]
            _report(0, lever, cofactor, pair, 0 if stronger else size, j, row, column, omega, maps)
            _report(1, lever, cofactor, pair, size if stronger else 0, j, row, column, omega, maps)
        flags[0, row, column] = found
        flags[1, row, column] = 0
        free = real_values(first, count) - 2.0 * found
        planes[2, row, column] = unit * np.sqrt(squares / free) if free > 0.0 else np.nan


@kernel
def hand_over(
    plan: Plan, chunk: Chunk, lanes: int, opened: NDArray[np.int64], still: int, known: Floats
) -> int:
    """Write columns and first returns of open pixels for `search`; return how many there are."""
    v, vtt = plan.sums[V], plan.sums[VTT]
    lever = plan.sums[VT4] - vtt * vtt / v
    one, settled, is_known, places = chunk.one, chunk.settled, chunk.known, chunk.column
    for j in range(lanes):
        if settled[j] != OPEN:
            continue
        column = places[j]
        opened[still] = column
        still += 1
        known[AMPLITUDE, column] = 0.0
        if is_known[j]:
            a, omega = one[one_each.AMPLITUDE + j], one[one_each.OMEGA + j]
            known[OMEGA, column] = omega
            known[COS, column] = np.cos(omega)
            known[SIN, column] = np.sin(omega)
            known[AMPLITUDE, column] = a
            known[VARIANCE, column] = 1.0 / (a * a * vtt)
            known[SPREAD, column] = -2.0 * one[FALL + j] / (a * lever)
            known[SPREAD + 1, column] = one[SQUARES + j]
    return still
