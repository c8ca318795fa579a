"""The pixels of a row that are resolved many at a time: those with one return, or with two.

Pixels whose two returns are close or slow to converge are deferred until a batch of them is full. Whatever is
not plain here (densities left out, three returns, no convergence) stays unresolved for `search`, with the
first return where that is significant.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.compilation import inner, kernel
from sms_jobs.metrology.phase.ranging import batched_fit, batched_sums, reference_fit
from sms_jobs.metrology.phase.ranging.batched_fit import (
    GAIN,
    PAIR_SIZE,
    SMALL,
    fit_one,
    fit_two,
    is_done,
)
from sms_jobs.metrology.phase.ranging.batched_sums import (
    FALL,
    GROUP,
    SIZE,
    SQUARES,
    STEP_TIMES_S,
    Room,
    new_room,
    write_pairs,
)
from sms_jobs.metrology.phase.ranging.close_start import start_close
from sms_jobs.metrology.phase.ranging.plan import (
    CLOSE_BINS,
    Plan,
    freedom,
    is_excessive,
    may_hold_another,
)
from sms_jobs.metrology.phase.ranging.row import Row
from sms_jobs.metrology.phase.ranging.transform import LANES, Peaks, find_peaks, new_peaks, wrapped

# The status of a pixel: how many returns it has, or one of these.
NONE, ONE, TWO = 0, 1, 2
UNRESOLVED = -1
DEFERRED = -2

_FEW = 6  # pixels that are fitted one by one at less cost than a batch of them together
_STEPS, _MORE_STEPS = 4, 12  # of the fit of two returns, the latter for deferred pixels
_NEAREST_BINS = 0.06  # two returns nearer than this are not separated here
_CENTRED = 1.0  # step of omega, times s, at which one return is near enough to the middle of two


class Scratch(NamedTuple):
    """What batch after batch uses: peaks, room of the fits, and which pixels matter."""

    peaks: Peaks
    room: Room
    active: Mask


class Batch(NamedTuple):
    """`LANES` pixels of a row.

    Attributes
    ----------
    x, y
        Their signals, (densities up to a multiple of `GROUP`, LANES), or what is left of them.
    single, pair
        Estimates of `fit_one` and `fit_two`.
    column, status
        (LANES,)
    significant
        (LANES,): whether the one return stands out of what it leaves.
    close
        (LANES,): whether two returns are too close to start at two peaks.
    variance
        Of z, (LANES,).
    """

    x: Singles
    y: Singles
    single: Floats
    pair: Floats
    column: Ints
    status: Ints
    significant: Mask
    close: Mask
    variance: Floats


@inner
@kernel
def _new_batch(densities: int) -> Batch:
    padded = (densities + GROUP - 1) // GROUP * GROUP
    return Batch(
        np.zeros((padded, LANES), np.float32),
        np.zeros((padded, LANES), np.float32),
        np.zeros(SIZE),
        np.zeros(PAIR_SIZE),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.bool_),
        np.ones(LANES),
    )


@inner
@kernel
def _load(row: Row, start: int, lanes: int, batch: Batch) -> None:
    """Take the pixels from column `start` on."""
    signal, x, y = row.signal, batch.x, batch.y
    for t in range(signal.shape[1]):
        for j in range(lanes):
            # An unsigned index needs no look at its sign, which would keep this from being a vector copy.
            x[t, j] = signal[0, t, np.uint64(start + j)]
            y[t, j] = signal[1, t, np.uint64(start + j)]


@inner
@kernel
def _search_left(plan: Plan, scratch: Scratch) -> None:
    """Find the peaks of what the fitted returns leave."""
    left_x, left_y = scratch.room.left_x.reshape(-1, LANES), scratch.room.left_y.reshape(-1, LANES)
    find_peaks(left_x, left_y, plan.weights.search, plan.first, plan.transform, scratch.peaks)


@inner
@kernel
def _fit_one(plan: Plan, batch: Batch, scratch: Scratch) -> None:
    """Fit one return to all pixels; those are resolved whose last step was small.

    Small is also what is small against its own standard deviation.
    """
    single, status, significant, variances = batch.single, batch.status, batch.significant, batch.variance
    single[:LANES] = scratch.peaks.omega
    fit_one(
        batch.x,
        batch.y,
        plan.densities,
        plan.first,
        plan.weights,
        plan.sums,
        single,
        scratch.room,
    )
    v, vtt = plan.sums.v, plan.sums.vtt
    free = freedom(plan.first, plan.densities, ONE)
    square = plan.threshold * plan.threshold
    for j in range(LANES):
        a, variance = single[batched_sums.AMPLITUDE + j], variances[j]
        floor = max(variance, single[SQUARES + j] / free)
        width = plan.densities * np.sqrt(floor / (a * a * vtt))
        step = abs(single[STEP_TIMES_S + j])
        small = step < max(SMALL, min(4.0 * width, 4.0 * SMALL))
        visible = a > 0.0 and a * a * v > square * variance
        significant[j] = small and a > 0.0 and a * a * v > square * floor
        if small:
            # A strong second return would count as noise of the first, and is looked for before that.
            status[j] = ONE if visible else NONE
        else:
            status[j] = DEFERRED if visible and step < _CENTRED else UNRESOLVED


@inner
@kernel
def _choose_candidates(plan: Plan, batch: Batch, scratch: Scratch) -> int:
    """Start the fit of two returns where one leaves enough for another; return in how many pixels.

    Pixels whose second return is close to the first are deferred.
    """
    single, pair, status, active = batch.single, batch.pair, batch.status, scratch.active
    significant, close, variance = batch.significant, batch.close, batch.variance
    peak_omega, peak_height = scratch.peaks.omega, scratch.peaks.height
    free = freedom(plan.first, plan.densities, ONE)
    unit = np.sqrt(plan.sums.search_noise)
    scale, nearest = plan.sums.search, CLOSE_BINS * 2.0 * pi / plan.densities
    chosen = 0
    for j in range(LANES):
        omega = single[batched_sums.OMEGA + j]
        active[j] = False
        second, height = omega + 2.0, 0.0
        if status[j] == ONE:
            height = peak_height[j]
            if may_hold_another(plan.threshold, free, variance[j], single[SQUARES + j], height / unit):
                second = peak_omega[j]
                close[j] = not abs(wrapped(second - omega)) > nearest
                active[j] = not close[j]
                status[j] = DEFERRED if close[j] else ONE
            elif not significant[j]:
                status[j] = NONE
        chosen += 1 if active[j] else 0
        pair[batched_sums.OMEGA + j] = omega
        pair[batched_sums.AMPLITUDE + j] = single[batched_sums.AMPLITUDE + j]
        pair[SIZE + batched_sums.OMEGA + j] = second
        pair[SIZE + batched_sums.AMPLITUDE + j] = max(height, 0.0) / scale
    return chosen


@inner
@kernel
def _fit_two(plan: Plan, steps: int, alone: bool, most: int, batch: Batch, scratch: Scratch) -> None:
    """Fit two returns to the active pixels; those that converged are resolved, the others deferred."""
    single, pair, status, active, variance = (
        batch.single,
        batch.pair,
        batch.status,
        scratch.active,
        batch.variance,
    )
    close, significant = batch.close, batch.significant
    fit_two(
        batch.x,
        batch.y,
        plan.densities,
        plan.first,
        plan.weights,
        plan.sums,
        plan.overlaps,
        steps,
        alone,
        active,
        variance,
        pair,
        scratch.room,
    )
    free = freedom(plan.first, plan.densities, TWO)
    one_bin, square = 2.0 * pi / plan.densities, plan.threshold * plan.threshold
    found = 0
    for j in range(LANES):
        if not active[j]:
            continue
        apart = abs(wrapped(pair[SIZE + batched_sums.OMEGA + j] - pair[batched_sums.OMEGA + j]))
        weaker = min(pair[batched_sums.AMPLITUDE + j], pair[SIZE + batched_sums.AMPLITUDE + j])
        strength, gained = single[batched_sums.AMPLITUDE + j], single[SQUARES + j] - pair[SQUARES + j]
        least_gain = square * max(variance[j], pair[SQUARES + j] / max(free, 1.0))
        status[j] = DEFERRED
        if (
            weaker > 0.0
            and apart > (_NEAREST_BINS if close[j] else CLOSE_BINS) * one_bin
            and is_done(pair[STEP_TIMES_S + j], pair[GAIN + j], variance[j])
        ):
            # What hides in much that is left is for the search to find.
            if gained > least_gain and (significant[j] or strength * strength * plan.sums.v > least_gain):
                status[j] = TWO
                found += 1
            elif significant[j] and not is_excessive(plan.threshold, free, variance[j], pair[SQUARES + j]):
                status[j] = ONE
    if found > 0 and most > TWO:
        _open_thirds(plan, free, batch, scratch)


@inner
@kernel
def _open_thirds(plan: Plan, free: float, batch: Batch, scratch: Scratch) -> None:
    """Open the pixels again in which two returns leave enough for a third."""
    _search_left(plan, scratch)
    pair, status, variance, height = batch.pair, batch.status, batch.variance, scratch.peaks.height
    unit = np.sqrt(plan.sums.search_noise)
    for j in range(LANES):
        if status[j] == TWO and may_hold_another(
            plan.threshold, free, variance[j], pair[SQUARES + j], height[j] / unit
        ):
            status[j] = UNRESOLVED


@inner
@kernel
def _resolve(plan: Plan, row: Row, start: int, lanes: int, batch: Batch, scratch: Scratch) -> None:
    """Resolve what can be resolved of the pixels from column `start` on."""
    most, missing = row.estimates.shape[1], row.lost[plan.densities]
    batch.close[:] = True
    for j in range(lanes):
        batch.column[j] = start + j
        batch.variance[j] = row.variance[start + j]
    _load(row, start, lanes, batch)
    find_peaks(batch.x, batch.y, plan.weights.search, plan.first, plan.transform, scratch.peaks)
    _fit_one(plan, batch, scratch)
    if most > ONE:
        _search_left(plan, scratch)
        chosen = _choose_candidates(plan, batch, scratch)
        if chosen > _FEW:
            _fit_two(plan, int(np.int64(_STEPS)), bool(np.bool_(True)), most, batch, scratch)
        elif chosen > 0:
            batch.status[scratch.active] = DEFERRED
    for j in range(lanes):
        if missing[start + j] > 0:
            # No weights here hold for it.
            batch.status[j] = UNRESOLVED
            batch.significant[j] = False
        elif most == ONE and batch.status[j] == DEFERRED:
            batch.status[j] = UNRESOLVED
        elif most == ONE and not batch.significant[j] and batch.status[j] == ONE:
            batch.status[j] = NONE


@inner
@kernel
def _defer(source: Batch, start: int, lanes: int, target: Batch, filled: int) -> tuple[int, int]:
    """Move deferred pixels, from lane `start` on, to the next free lanes of another batch.

    Returns the lane from which on pixels are still to be moved, since the other batch was full, and how many
    of its lanes are filled.
    """
    status, column, single, pair = source.status, source.column, source.single, source.pair
    to_single, to_pair, to_column = target.single, target.pair, target.column
    significant, variance, close = source.significant, source.variance, source.close
    to_significant, to_variance, to_close = target.significant, target.variance, target.close
    # Each keeps its lane until its signal is moved.
    moved, lane, from_lane = 0, start, to_column
    while lane < lanes and filled + moved < LANES:
        if status[lane] == DEFERRED:
            from_lane[filled + moved] = lane
            moved += 1
        lane += 1
    for t in range(source.x.shape[0]):  # in the order in which signals lie in memory
        for k in range(filled, filled + moved):
            target.x[t, k] = source.x[t, from_lane[k]]
            target.y[t, k] = source.y[t, from_lane[k]]
    for k in range(filled, filled + moved):
        j = from_lane[k]
        for part in range(0, SIZE, LANES):
            to_single[part + k] = single[part + j]
        for part in range(0, PAIR_SIZE, LANES):
            to_pair[part + k] = pair[part + j]
        to_significant[k], to_close[k] = significant[j], close[j]
        to_column[k], to_variance[k] = column[j], variance[j]
    return lane, filled + moved


@inner
@kernel
def _resolve_deferred(plan: Plan, row: Row, filled: int, batch: Batch, scratch: Scratch) -> None:
    """Resolve what can be resolved of a batch of deferred pixels, and write it to the row."""
    batch.status[:] = UNRESOLVED
    if filled > _FEW:
        for j in range(LANES):
            scratch.active[j] = j < filled
        start_close(
            batch.x,
            batch.y,
            plan.first,
            plan.weights.u[0],
            plan.grid,
            batch.close,
            batch.single,
            batch.pair,
            scratch.room,
            scratch.peaks,
        )
        write_pairs(batch.x.reshape(-1), batch.y.reshape(-1), plan.weights.u[0], scratch.room.pairs)
        _fit_two(
            plan, int(np.int64(_MORE_STEPS)), bool(np.bool_(False)), row.estimates.shape[1], batch, scratch
        )
        batch.status[batch.status == DEFERRED] = UNRESOLVED
    _write(plan, row, filled, batch)


@inner
@kernel
def _write(plan: Plan, row: Row, lanes: int, batch: Batch) -> None:
    """Write pixels to their row: those that are resolved, and the first return of others."""
    vtt, spread = plan.sums.vtt, plan.sums.spread
    columns, status, significant = batch.column, batch.status, batch.significant
    estimates, counts, row_squares, resolved = row.estimates, row.returns, row.squares, row.resolved
    single, pair = batch.single, batch.pair
    for j in range(lanes):
        if status[j] == DEFERRED:
            continue
        column, count = columns[j], status[j]
        resolved[column] = count != UNRESOLVED
        if count == UNRESOLVED:
            count = ONE if significant[j] else NONE
        values = pair if count == TWO else single
        counts[column], row_squares[column] = count, values[SQUARES + j]
        for i in range(count):
            o = i * SIZE + j
            a = values[o + batched_sums.AMPLITUDE]
            cofactor = pair[batched_fit.VARIANCE + j] if count == TWO else 1.0 / vtt
            estimates[column, i, reference_fit.OMEGA] = values[o + batched_sums.OMEGA]
            estimates[column, i, reference_fit.AMPLITUDE] = a
            estimates[column, i, reference_fit.VARIANCE] = cofactor / (a * a)
            estimates[column, i, reference_fit.SPREAD] = -2.0 * values[o + FALL] / (a * spread)


@inner
@kernel
def resolve_row(plan: Plan, row: Row, begin: int, end: int) -> None:
    """Find the returns of the plain pixels of one row, columns `begin` to `end`, and write them to it."""
    # Each row makes its batches anew: what the heap does not keep from row to row would cost more than it
    # holds.
    batch = _new_batch(plan.densities)
    # Nothing is deferred where one return is looked for.
    deferred = _new_batch(plan.densities) if row.estimates.shape[1] > ONE else batch
    scratch = Scratch(
        new_peaks(plan.transform.order.size),
        new_room(batch.x.shape[0]),
        np.zeros(LANES, np.bool_),
    )
    # Of this type from the start: Numba compiles what is called with a literal once more for that literal.
    filled = int(np.int64(0))
    for start in range(begin, end, LANES):
        lanes = min(LANES, end - start)
        _resolve(plan, row, start, lanes, batch, scratch)
        lane = int(np.int64(0))
        while lane < lanes:
            lane, filled = _defer(batch, lane, lanes, deferred, filled)
            if filled == LANES:
                _resolve_deferred(plan, row, filled, deferred, scratch)
                filled = int(np.int64(0))
        _write(plan, row, lanes, batch)
    if filled > 0:
        _resolve_deferred(plan, row, filled, deferred, scratch)
