"""The pixels of a row that are settled many at a time: those with one return, or with two.

Pixels whose two returns are close or slow to converge wait for others like them and are fitted in chunks of
their own. Whatever is not plain here (lost densities, three returns, no convergence) is left open for
`search`, with the first return where it is known.
"""

from __future__ import annotations

from math import pi
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.phase.ranging import one_each, two_each
from sms_jobs.metrology.phase.ranging.chunk import (
    LATER,
    ONE,
    OPEN,
    TWO,
    Chunk,
    beside,
    collect,
    find_peaks,
    hand_over,
    load,
    new_chunk,
    report,
)
from sms_jobs.metrology.phase.ranging.fit import SEARCH, VTT, G, N, V
from sms_jobs.metrology.phase.ranging.of_pixel import (
    CLOSE,
    height_of_real_peak,
    start_of_real_peak,
    wrapped,
)
from sms_jobs.metrology.phase.ranging.one_each import SQUARES, STEP_TIMES_S, fit_one_each
from sms_jobs.metrology.phase.ranging.plan import Plan, is_excessive, is_worth_a_fit, real_values
from sms_jobs.metrology.phase.ranging.start import start_close
from sms_jobs.metrology.phase.ranging.transform import LANES
from sms_jobs.metrology.phase.ranging.two_each import fit_two_each, is_done

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

_FEW = 6  # pixels that are fitted one by one at less cost than a chunk of them together
_STEPS, _MORE_STEPS = 4, 12  # of the fit of two returns, the latter for pixels that wait
_NEAREST = 0.06  # bins; two returns nearer than this are not told apart here
_CENTRED = 1.0  # step of omega, times s, at which one return is near enough to the middle of two


@kernel
def _settle_ones(plan: Plan, count: int, chunk: Chunk) -> None:
    """Fit one return to all pixels of a chunk; settled are those whose last step was small.

    Small is also what is small against its own standard deviation. `x` and `y` become what is left.
    """
    one = chunk.one
    for j in range(LANES):
        one[one_each.OMEGA + j] = start_of_real_peak(chunk.spectrum, chunk.where[j], j)
    fit_one_each(chunk.x, chunk.y, count, plan.weights, plan.sums, plan.first, one, chunk.rotors, chunk.fast)
    v, vtt = plan.sums[V], plan.sums[VTT]
    free = real_values(plan.first, count) - 2.0
    square = plan.threshold * plan.threshold
    for j in range(LANES):
        a = one[one_each.AMPLITUDE + j]
        floor = max(chunk.variance[j], one[SQUARES + j] / free)
        width = count * np.sqrt(floor / (a * a * vtt))
        step = abs(one[STEP_TIMES_S + j])
        small = step < max(one_each.SMALL, min(4.0 * width, 4.0 * one_each.SMALL))
        chunk.known[j] = small and a > 0.0 and a * a * v > square * floor
        if small:
            # A strong second return would count as noise of the first, and is looked for before that.
            chunk.settled[j] = ONE if a > 0.0 and a * a * v > square * chunk.variance[j] else 0
        elif step < _CENTRED and a > 0.0 and a * a * v > square * chunk.variance[j]:
            chunk.settled[j] = LATER


@kernel
def _want_pairs(plan: Plan, count: int, chunk: Chunk) -> int:
    """Start the fit of two returns where one leaves enough for another; return in how many pixels.

    Pixels whose second return is close to the first have to wait.
    """
    free = real_values(plan.first, count) - 2.0
    scale = 0.0
    for t in range(count):
        scale += plan.weights[SEARCH, t] * plan.weights[G, t]
    wanted = 0
    for j in range(LANES):
        omega = chunk.one[one_each.OMEGA + j]
        chunk.wanted[j] = False
        second, height = omega + 2.0, 0.0
        if chunk.settled[j] == ONE:
            height = height_of_real_peak(chunk.spectrum, chunk.where[j], j)
            if is_worth_a_fit(
                plan.threshold, free, chunk.variance[j], chunk.one[SQUARES + j], plan.sums[N], height
            ):
                second = start_of_real_peak(chunk.spectrum, chunk.where[j], j)
                chunk.wanted[j] = abs(wrapped(second - omega)) > CLOSE * 2.0 * pi / count
                chunk.settled[j] = ONE if chunk.wanted[j] else LATER
                chunk.near[j] = not chunk.wanted[j]
            elif not chunk.known[j]:
                chunk.settled[j] = 0
        wanted += 1 if chunk.wanted[j] else 0
        chunk.pair[one_each.OMEGA + j] = omega
        chunk.pair[one_each.AMPLITUDE + j] = chunk.one[one_each.AMPLITUDE + j]
        chunk.pair[one_each.SIZE + one_each.OMEGA + j] = second
        chunk.pair[one_each.SIZE + one_each.AMPLITUDE + j] = max(height, 0.0) / scale
    return wanted


@kernel
def _settle_pairs(plan: Plan, count: int, steps: int, chunk: Chunk) -> int:
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
        steps,
        pair,
        chunk.rotors,
        chunk.fast,
    )
    free = real_values(plan.first, count) - 4.0
    found = 0
    for j in range(LANES):
        if not chunk.wanted[j]:
            continue
        first, second = pair[one_each.OMEGA + j], pair[one_each.SIZE + one_each.OMEGA + j]
        least = min(pair[one_each.AMPLITUDE + j], pair[one_each.SIZE + one_each.AMPLITUDE + j])
        one, gained = chunk.one[one_each.AMPLITUDE + j], chunk.one[SQUARES + j] - pair[SQUARES + j]
        floor = max(chunk.variance[j], pair[SQUARES + j] / max(free, 1.0))
        least_gain = plan.threshold * plan.threshold * floor
        chunk.settled[j] = LATER
        if (
            least > 0.0
            and abs(wrapped(second - first)) > (_NEAREST if chunk.near[j] else CLOSE) * 2.0 * pi / count
            and is_done(pair[STEP_TIMES_S + j], pair[two_each.GAIN + j], chunk.variance[j])
        ):
            # What hides in much that is left is for others to find.
            if gained > least_gain and (chunk.known[j] or one * one * plan.sums[V] > least_gain):
                chunk.settled[j] = TWO
                found += 1
            elif chunk.known[j] and not is_excessive(
                plan.threshold, free, chunk.variance[j], pair[SQUARES + j]
            ):
                chunk.settled[j] = ONE
    return found


@kernel
def _open_thirds(plan: Plan, count: int, chunk: Chunk) -> None:
    """Open the pixels again in which two returns leave enough for a third."""
    find_peaks(plan, chunk)
    free = real_values(plan.first, count) - 4.0
    for j in range(LANES):
        if chunk.settled[j] == TWO and is_worth_a_fit(
            plan.threshold,
            free,
            chunk.variance[j],
            chunk.pair[SQUARES + j],
            plan.sums[N],
            height_of_real_peak(chunk.spectrum, chunk.where[j], j),
        ):
            chunk.settled[j] = OPEN


@kernel
def _settle(plan: Plan, signal: Single, start: int, lanes: int, most: int, chunk: Chunk) -> None:
    """Settle what can be settled of a chunk."""
    count = signal.shape[1]
    load(signal, start, lanes, chunk.x, chunk.y)
    find_peaks(plan, chunk)
    _settle_ones(plan, count, chunk)
    if most == 1:
        for j in range(LANES):
            if chunk.settled[j] == ONE and not chunk.known[j]:
                chunk.settled[j] = 0
        return
    find_peaks(plan, chunk)
    wanted = _want_pairs(plan, count, chunk)
    if wanted > _FEW:
        load(signal, start, lanes, chunk.x, chunk.y)
        if _settle_pairs(plan, count, int(np.int64(_STEPS)), chunk) > 0 and most > 2:
            _open_thirds(plan, count, chunk)
    elif wanted > 0:
        for j in range(LANES):
            if chunk.wanted[j]:
                chunk.settled[j] = LATER


@kernel
def _begin(plan: Plan, start: int, lanes: int, levels: Single, chunk: Chunk) -> None:
    """Begin with the pixels from column `start` on, of which nothing is known."""
    for j in range(LANES):
        chunk.settled[j] = OPEN
        chunk.near[j] = True
        chunk.column[j] = start + j
        chunk.variance[j] = plan.variance + plan.slope * levels[start + j] if j < lanes else 1.0


@kernel
def _open_lost(lost: NDArray[np.uint8], lanes: int, most: int, chunk: Chunk) -> None:
    """Open the pixels that miss densities, for whose weights nothing here holds."""
    for j in range(lanes):
        if lost[chunk.column[j]] > 0:
            chunk.settled[j] = OPEN
            chunk.known[j] = False
        elif chunk.settled[j] == LATER and most == 1:
            chunk.settled[j] = OPEN


@kernel
def _settle_waiting(plan: Plan, count: int, filled: int, most: int, chunk: Chunk) -> None:
    """Settle what can be settled of a chunk of pixels that have waited."""
    for j in range(LANES):
        chunk.wanted[j] = j < filled and filled > _FEW
        chunk.settled[j] = OPEN
    if filled <= _FEW:
        return
    start_close(
        chunk.x,
        chunk.y,
        plan.weights,
        plan.first,
        plan.grid,
        chunk.one,
        chunk.near,
        chunk.pair,
        chunk.rotors,
        chunk.fast,
        chunk.spectrum,
        chunk.best,
        chunk.where,
    )
    if _settle_pairs(plan, count, int(np.int64(_MORE_STEPS)), chunk) > 0 and most > 2:
        _open_thirds(plan, count, chunk)
    for j in range(filled):
        if chunk.settled[j] == LATER:
            chunk.settled[j] = OPEN


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

    The other parameters are those of `search.find_jointly`; those of settled pixels are written.
    """
    count, columns, most = signal.shape[1], signal.shape[2], omega.shape[0]
    chunk = new_chunk(plan, count)
    waiting = beside(chunk)
    # Of these types from the start: Numba compiles what is called with a literal once more for that literal.
    still, filled = int(np.int64(0)), int(np.int64(0))
    for start in range(0, columns, LANES):
        lanes = min(LANES, columns - start)
        _begin(plan, start, lanes, planes[0, row], chunk)
        _settle(plan, signal, start, lanes, most, chunk)
        _open_lost(lost[count], lanes, most, chunk)
        lane = int(np.int64(0))
        while lane < lanes:
            lane, filled = collect(signal, chunk, lane, lanes, waiting, filled)
            if filled == LANES:
                _settle_waiting(plan, count, filled, most, waiting)
                report(plan, waiting, count, filled, row, omega, maps, planes, flags)
                still = hand_over(plan, waiting, filled, opened, still, known)
                filled = int(np.int64(0))
        report(plan, chunk, count, lanes, row, omega, maps, planes, flags)
        still = hand_over(plan, chunk, lanes, opened, still, known)
    if filled > 0:
        _settle_waiting(plan, count, filled, most, waiting)
        report(plan, waiting, count, filled, row, omega, maps, planes, flags)
        still = hand_over(plan, waiting, filled, opened, still, known)
    return still
