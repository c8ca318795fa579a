"""The returns of given pixels of a row: find a peak, fit it, test it, and look at what is left.

Peaks are searched for in chunks of `LANES` pixels, fitted pixel by pixel.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel, summing_kernel
from sms_jobs.metrology.phase.ranging.fit import (
    AMPLITUDE,
    OMEGA,
    SEARCH,
    SPREAD,
    VARIANCE,
    N,
    P,
    V,
    copy_state,
    power,
)
from sms_jobs.metrology.phase.ranging.of_pixel import (
    add_jointly,
    height_of_real_peak,
    peel,
    remove,
    spread,
    start_of_modulus_peak,
    start_of_real_peak,
    wrapped,
)
from sms_jobs.metrology.phase.ranging.plan import MODULUS, ORIGINAL, Plan, is_worth_a_fit, real_values
from sms_jobs.metrology.phase.ranging.transform import LANES, modulus_peaks, real_peaks

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]


class _Chunk(NamedTuple):
    """Buffers of a chunk of pixels: for the search (densities, LANES), for the fit (LANES, 2, densities)."""

    x: Single
    y: Single
    spectrum: Single
    best: Single
    where: NDArray[np.int32]
    lost: NDArray[np.uint8]
    pixels: Single
    left: Single
    rest: Single
    weights: Single
    sums: Floats
    states: Floats
    found: NDArray[np.int64]
    active: NDArray[np.bool_]
    missing: NDArray[np.int64]
    squares: Floats
    gain: Floats
    variance: Floats
    work: Floats
    tables: Single
    system: Floats


@kernel
def _chunk(plan: Plan, count: int, most: int) -> _Chunk:
    """Return the buffers of a chunk."""
    rows, padded = plan.weights.shape
    weights, sums = np.zeros((2, rows, padded), np.float32), np.zeros((2, rows))
    weights[0] = plan.weights
    sums[0] = plan.sums
    return _Chunk(
        np.zeros((count, LANES), np.float32),
        np.zeros((count, LANES), np.float32),
        np.empty((2, plan.order.size, LANES), np.float32),
        np.empty(LANES, np.float32),
        np.empty(LANES, np.int32),
        np.zeros((count, LANES), np.uint8),
        np.zeros((LANES, 2, padded), np.float32),
        np.zeros((LANES, 2, padded), np.float32),
        np.zeros((LANES, 2, padded), np.float32),
        weights,
        sums,
        np.zeros((LANES, 6, most)),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.int64),
        np.zeros(LANES),
        np.zeros(LANES),
        np.zeros(LANES),
        np.zeros((3, 6, most)),
        np.zeros((most, 2, padded), np.float32),
        np.zeros((6, max(most, 6), most + 1)),
    )


@summing_kernel
def _to_lanes(pixels: Single, x: Single, y: Single) -> None:
    for t in range(x.shape[0]):
        for j in range(LANES):
            x[t, j] = pixels[j, 0, t]
            y[t, j] = pixels[j, 1, t]


@summing_kernel
def _to_pixels(x: Single, y: Single, pixels: Single) -> None:
    for j in range(LANES):
        for t in range(x.shape[0]):
            pixels[j, 0, t] = x[t, j]
            pixels[j, 1, t] = y[t, j]


@kernel
def _load(
    plan: Plan, signal: Single, lost: NDArray[np.uint8], columns: NDArray[np.int64], chunk: _Chunk
) -> None:
    """Take the pixels of some columns into the buffers; those with enough densities are active."""
    count = signal.shape[1]
    for t in range(count):
        for j in range(columns.size):
            chunk.x[t, j] = signal[0, t, columns[j]]
            chunk.y[t, j] = signal[1, t, columns[j]]
            chunk.lost[t, j] = lost[t, columns[j]]
    _to_pixels(chunk.x, chunk.y, chunk.pixels)
    for j in range(LANES):
        chunk.found[j] = 0
        chunk.gain[j] = np.inf
        chunk.missing[j] = lost[count, columns[j]] if j < columns.size else 0
        chunk.active[j] = j < columns.size and count - chunk.missing[j] >= plan.least


@kernel
def _weights_of(missing: int, lost: NDArray[np.uint8], j: int, weights: Single, sums: Floats) -> int:
    """Return which weights hold for a pixel; those without its lost densities are made here."""
    if missing == 0:
        return 0
    for k in range(weights.shape[1]):
        sums[1, k] = 0.0
        for t in range(lost.shape[0]):
            weights[1, k, t] = 0.0 if lost[t, j] else weights[0, k, t]
            sums[1, k] += weights[1, k, t]
    return 1


@kernel
def _find_peaks(plan: Plan, chunk: _Chunk) -> None:
    """Transform what `x` and `y` hold, and find the highest sample of every pixel."""
    weights, turns, order = plan.weights[SEARCH], plan.turns, plan.order
    if plan.mode & MODULUS:
        modulus_peaks(
            chunk.x, chunk.y, weights, plan.first, turns, order, chunk.spectrum, chunk.best, chunk.where
        )
    else:
        real_peaks(
            chunk.x, chunk.y, weights, plan.first, turns, order, chunk.spectrum, chunk.best, chunk.where
        )


@kernel
def _fit_pixel(plan: Plan, lost: NDArray[np.uint8], chunk: _Chunk, i: int, j: int) -> None:
    """Add return i to a pixel if that is worth it; what is left then replaces the pixel in `x` and `y`."""
    m = _weights_of(chunk.missing[j], lost, j, chunk.weights, chunk.sums)
    values = real_values(plan.first, lost.shape[0] - chunk.missing[j])
    variance = chunk.variance[j]
    if i == 0:
        chunk.squares[j] = power(chunk.pixels, j, chunk.weights, m, P)
    height = height_of_real_peak(chunk.spectrum, chunk.where[j], j)
    if i > 0 and not is_worth_a_fit(
        plan.threshold, values - 2.0 * i, variance, chunk.squares[j], chunk.sums[m, N], height
    ):
        return
    # A strong second return would count as noise of the first, which is therefore tested last of all.
    squares = add_jointly(
        i + 1,
        chunk.pixels,
        j,
        chunk.weights,
        chunk.sums,
        m,
        plan.first,
        (variance, plan.threshold, values if i > 0 else np.inf),
        start_of_real_peak(chunk.spectrum, chunk.where[j], j),
        chunk.squares[j],
        chunk.states,
        chunk.work,
        chunk.tables,
        chunk.left,
        chunk.system,
    )
    if squares >= 0.0:
        if i == 0:
            chunk.gain[j] = chunk.squares[j] - squares
        chunk.squares[j] = squares
        chunk.found[j] = i + 1
        for t in range(chunk.x.shape[0]):
            chunk.x[t, j] = chunk.left[j, 0, t]
            chunk.y[t, j] = chunk.left[j, 1, t]


@kernel
def _find_jointly(plan: Plan, chunk: _Chunk) -> None:
    """Find the returns of a chunk, each new one fitted together with those that are known."""
    for i in range(chunk.states.shape[2]):
        remaining = 0
        _find_peaks(plan, chunk)
        for j in range(LANES):
            if chunk.active[j] and chunk.found[j] == i:
                _fit_pixel(plan, chunk.lost, chunk, i, j)
            chunk.active[j] = chunk.found[j] > i
            remaining += 1 if chunk.active[j] else 0
        if remaining == 0:
            break
    for j in range(LANES):
        values = real_values(plan.first, chunk.lost.shape[0] - chunk.missing[j])
        left = chunk.squares[j] / max(values - 2.0 * chunk.found[j], 1.0)
        if not chunk.gain[j] > plan.threshold * plan.threshold * max(chunk.variance[j], left):
            chunk.found[j] = 0


@kernel
def _peel_pixel(plan: Plan, lost: NDArray[np.uint8], chunk: _Chunk, sweep: int, i: int, j: int) -> None:
    """Fit return i of a pixel to what `left` holds; in the first sweep, count it if it is significant."""
    m = _weights_of(chunk.missing[j], lost, j, chunk.weights, chunk.sums)
    known_origin = plan.mode & MODULUS == 0
    if known_origin:
        start = start_of_real_peak(chunk.spectrum, chunk.where[j], j)
    else:
        start = start_of_modulus_peak(chunk.spectrum, chunk.where[j], j, plan.mode & ORIGINAL == 0)
    peel(
        i,
        chunk.left,
        j,
        chunk.weights,
        chunk.sums,
        m,
        plan.first,
        start,
        known_origin,
        chunk.states,
        chunk.work,
        chunk.tables,
        chunk.rest,
        chunk.system,
    )
    if sweep > 0:
        return
    squares = _without(plan, chunk, m, j, i + 1, int(np.int64(-1)))
    freedom = max(real_values(plan.first, lost.shape[0] - chunk.missing[j]) - 2.0 * (i + 1), 1.0)
    floor = max(chunk.variance[j], squares / freedom)
    score = chunk.states[j, AMPLITUDE, i] * chunk.sums[m, V]
    if score > plan.threshold * np.sqrt(chunk.sums[m, N] * floor):
        chunk.found[j] = i + 1
    else:
        chunk.active[j] = False


@kernel
def _without(plan: Plan, chunk: _Chunk, m: int, j: int, found: int, kept: int) -> float:
    """Put into `left` what a pixel is without its returns but one, and return the sum of its squares."""
    return remove(
        chunk.pixels,
        j,
        chunk.weights,
        m,
        plan.first,
        chunk.states,
        found,
        kept,
        chunk.tables,
        chunk.left,
    )


@kernel
def _find_by_peeling(plan: Plan, chunk: _Chunk) -> None:
    """Find the returns of a chunk one by one: thesis section 7.2.3, steps 1 to 4."""
    most = chunk.states.shape[2]
    for sweep in range(plan.refinements + 1 if most > 1 else 1):
        for i in range(most):
            for j in range(LANES):
                if chunk.active[j] if sweep == 0 else i < chunk.found[j]:
                    m = _weights_of(chunk.missing[j], chunk.lost, j, chunk.weights, chunk.sums)
                    _without(plan, chunk, m, j, chunk.found[j], i)
            _to_lanes(chunk.left, chunk.x, chunk.y)
            _find_peaks(plan, chunk)
            for j in range(LANES):
                if chunk.active[j] if sweep == 0 else i < chunk.found[j]:
                    _peel_pixel(plan, chunk.lost, chunk, sweep, i, j)
    for j in range(LANES):
        if chunk.found[j] > 0:
            m = _weights_of(chunk.missing[j], chunk.lost, j, chunk.weights, chunk.sums)
            chunk.squares[j] = _without(plan, chunk, m, j, chunk.found[j], int(np.int64(-1)))
            copy_state(chunk.found[j], chunk.states, j, chunk.work, 0)
            spread(chunk.found[j], chunk.weights, chunk.sums, m, chunk.work, chunk.tables, chunk.left, j)
            copy_state(chunk.found[j], chunk.work, 0, chunk.states, j)


@kernel
def _report(
    found: int, states: Floats, j: int, variance: float, row: int, column: int, omega: Floats, maps: Single
) -> None:
    """Write the returns of pixel j, strongest first, NaN beyond."""
    for i in range(found, omega.shape[0]):
        omega[i, row, column] = np.nan
        for k in range(3):
            maps[k, i, row, column] = np.nan
    for i in range(found):
        rank = 0
        for k in range(found):
            a, b = states[j, AMPLITUDE, k], states[j, AMPLITUDE, i]
            rank += 1 if a > b or (a == b and k < i) else 0
        omega[rank, row, column] = wrapped(states[j, OMEGA, i])
        maps[0, rank, row, column] = np.sqrt(variance * states[j, VARIANCE, i])
        maps[1, rank, row, column] = states[j, AMPLITUDE, i]
        maps[2, rank, row, column] = np.sqrt(max(states[j, SPREAD, i], 0.0))


@kernel
def _begin(
    plan: Plan,
    signal: Single,
    lost: NDArray[np.uint8],
    columns: NDArray[np.int64],
    row: int,
    planes: Single,
    flags: NDArray[np.uint8],
    chunk: _Chunk,
) -> None:
    """Take the pixels of some columns into a chunk, and mark those with too few densities."""
    _load(plan, signal, lost, columns, chunk)
    for j in range(columns.size):
        chunk.variance[j] = plan.variance + plan.slope * planes[0, row, columns[j]]
        flags[1, row, columns[j]] = 0 if chunk.active[j] else 1


@kernel
def _take_known(plan: Plan, columns: NDArray[np.int64], known: Floats, chunk: _Chunk) -> None:
    """Begin with the first returns that are known, and with what they leave."""
    for j in range(columns.size):
        if not known[AMPLITUDE, columns[j]] > 0.0:
            continue
        for k in range(chunk.states.shape[1]):
            chunk.states[j, k, 0] = known[k, columns[j]]
        _without(plan, chunk, int(np.int64(0)), j, int(np.int64(1)), int(np.int64(-1)))
        chunk.found[j] = 1
        chunk.squares[j] = known[chunk.states.shape[1], columns[j]]
        for t in range(chunk.x.shape[0]):
            chunk.x[t, j] = chunk.left[j, 0, t]
            chunk.y[t, j] = chunk.left[j, 1, t]


@kernel
def _end(
    plan: Plan,
    columns: NDArray[np.int64],
    row: int,
    omega: Floats,
    maps: Single,
    planes: Single,
    flags: NDArray[np.uint8],
    chunk: _Chunk,
) -> None:
    """Write what was found in a chunk."""
    for j in range(columns.size):
        found, column = chunk.found[j], columns[j]
        _report(found, chunk.states, j, chunk.variance[j], row, column, omega, maps)
        flags[0, row, column] = found
        freedom = real_values(plan.first, chunk.lost.shape[0] - chunk.missing[j]) - 2.0 * found
        sound = found > 0 and freedom > 0.0
        planes[2, row, column] = plan.unit * np.sqrt(chunk.squares[j] / freedom) if sound else np.nan


@kernel
def find_jointly(
    plan: Plan,
    signal: Single,
    lost: NDArray[np.uint8],
    columns: NDArray[np.int64],
    known: Floats,
    row: int,
    omega: Floats,
    maps: Single,
    planes: Single,
    flags: NDArray[np.uint8],
) -> None:
    """Find the returns of some pixels of one row, all of a pixel fitted together.

    Parameters
    ----------
    plan
        What is the same for all pixels.
    signal, lost
        z, (2, densities, columns), and 1 where a density is left out with the number of these in a last row,
        (densities + 1, columns).
    columns
        Which pixels.
    known
        Their first return, of `settled.settle_row`.
    row, omega, maps, planes, flags
        Which row of (returns, rows, columns); of (3, returns, rows, columns): standard deviation, amplitude,
        width; of (3, rows, columns): the mean grey level, which is given, another, residual; and of
        (2, rows, columns): count, 1 where too few densities are left. They are written.
    """
    chunk = _chunk(plan, signal.shape[1], omega.shape[0])
    for start in range(0, columns.size, LANES):
        here = columns[start : start + LANES]
        _begin(plan, signal, lost, here, row, planes, flags, chunk)
        _take_known(plan, here, known, chunk)
        _find_jointly(plan, chunk)
        _end(plan, here, row, omega, maps, planes, flags, chunk)


@kernel
def find_by_peeling(
    plan: Plan,
    signal: Single,
    lost: NDArray[np.uint8],
    columns: NDArray[np.int64],
    row: int,
    omega: Floats,
    maps: Single,
    planes: Single,
    flags: NDArray[np.uint8],
) -> None:
    """Find the returns of some pixels of one row one by one; the parameters are those of `find_jointly`."""
    chunk = _chunk(plan, signal.shape[1], omega.shape[0])
    for start in range(0, columns.size, LANES):
        here = columns[start : start + LANES]
        _begin(plan, signal, lost, here, row, planes, flags, chunk)
        _find_by_peeling(plan, chunk)
        _end(plan, here, row, omega, maps, planes, flags, chunk)
