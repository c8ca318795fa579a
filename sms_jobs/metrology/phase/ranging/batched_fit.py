"""The fit of one or of two returns to each of `LANES` pixels at once.

Most pixels hold one return, and its fit from an interpolated peak needs a step or two. Done for all pixels of
a batch together it costs a tenth of what `reference_fit` takes. The steps are the same Gauss-Newton steps,
but that omega and amplitude move together. A batch holds signals as (densities, LANES): the loops over
densities inside a group are short and of constant length, so that the compiler unrolls them and makes vector
instructions of the loops over pixels.

The equations of two returns fall apart into sums and differences. With p_i = a_i d omega_i,
d = omega_1 - omega_2, C, T, K = sum v cos dt, sum v t sin dt, sum v t^2 cos dt, and V, Q = sum v, sum v t^2,
[[V - C, T], [T, Q + K]] holds for (a_1 - a_2, p_1 + p_2), [[V + C, -T], [-T, Q - K]] for
(a_1 + a_2, p_1 - p_2). C, T, K depend on d alone and come from a table.
"""

from __future__ import annotations

from math import pi

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import inner, summing_kernel
from sms_jobs.metrology.phase.ranging.batched_sums import (
    AMPLITUDE,
    ENTRY,
    IN_PHASE,
    IN_QUADRATURE,
    OMEGA,
    REGISTERS,
    SIZE,
    STEP_TIMES_S,
    Room,
    project,
    project_two,
    start_pairs,
    subtract_one,
    subtract_two,
    write_pairs,
)
from sms_jobs.metrology.phase.ranging.transform import LANES
from sms_jobs.metrology.phase.ranging.weights import Sums, Weights

# Parts of the estimate of two returns, behind those of both: the last step's gain in chi-square, the variance
# of a_i omega_i for unit noise, C, T, K, d, the two next derivatives of C, and how far d is off the table.
GAIN = 2 * SIZE
VARIANCE = 2 * SIZE + LANES
_OVER = 2 * SIZE + 2 * LANES
_SHIFT = 2 * SIZE + 3 * LANES
_CURVE = 2 * SIZE + 4 * LANES
_BETWEEN = 2 * SIZE + 5 * LANES
_THIRD = 2 * SIZE + 6 * LANES
_FOURTH = 2 * SIZE + 7 * LANES
_OFF = 2 * SIZE + 8 * LANES
PAIR_SIZE = 2 * SIZE + 9 * LANES

SMALL = 0.1  # step of omega of one return, times s, after which the cube of it that is left does not matter

_STEPS = 3
_LONGEST = 3.0  # step x s: half a bin
_BOLDEST = 0.4  # step over the distance of both returns, beyond which the linear model says little
_DONE = 0.01  # step x s of two returns after which no further one is needed: what is left is its square
_NEGLIGIBLE = 1e-2  # gain in chi-square that is not worth another step
_FINENESS = 128  # entries of the table a bin: what interpolation misses is 3e-7 of the sums


def overlap_table(densities: Floats, v: Floats) -> Floats:
    """Return sums of v cos dt, v t sin dt, v t^2 cos dt, v t^3 sin dt, v t^4 cos dt for d = 0 .. pi.

    (entries, 5), from v of every density: C and its derivatives but for their signs.
    """
    half = _FINENESS << max(int(densities[-1]).bit_length() - 1, 1)
    rows = np.zeros((5, int(densities[-1]) + 1))
    rows[:, densities.astype(np.int64)] = v * densities ** np.arange(5)[:, None]
    spectra = np.fft.rfft(rows, 2 * half, axis=1).T
    return np.where(np.arange(5) % 2, -spectra.imag, spectra.real)


@inner
@summing_kernel
def _move_one(sums: Sums, s: float, estimate: Floats, registers: Singles) -> float:
    """Turn the sums into amplitude and step of omega, half a bin at most; return the largest step times s."""
    per_v, per_s, lever = 1.0 / sums.v, 1.0 / s, s / sums.vtt
    for j in range(LANES):
        slope = np.float64(registers[IN_QUADRATURE + j])
        a = registers[IN_PHASE + j] * per_v
        step = lever * slope / max(a, 1e-30)
        step = max(min(step, _LONGEST), -_LONGEST)
        estimate[STEP_TIMES_S + j] = step
        step *= per_s
        estimate[AMPLITUDE + j] = a + 0.5 * slope * step * per_v  # at the end of the step
        estimate[OMEGA + j] += step
    largest = 0.0
    for j in range(LANES):
        largest = max(largest, abs(estimate[STEP_TIMES_S + j]))
    return largest


@inner
@summing_kernel
def fit_one(
    x: Singles,
    y: Singles,
    count: int,
    first: int,
    weights: Weights,
    sums: Sums,
    estimate: Floats,
    room: Room,
) -> None:
    """Fit one return to every pixel of a batch.

    Parameters
    ----------
    x, y
        z(t), (densities, LANES), 0 beyond `count` up to a multiple of `GROUP`.
    count, first
        Number of densities, and t of the first one.
    weights, sums
        Of pixels that no density is left out of.
    estimate
        (SIZE,): omega is the start, and becomes the end; amplitude, squares, fall and step are written.
    room
        Of `new_room`; the pairs of the signals and what the return leaves of these are left behind there.
    """
    flat_x, flat_y, registers = x.reshape(-1), y.reshape(-1), room.registers
    write_pairs(flat_x, flat_y, weights.u[0], room.pairs)
    for _ in range(_STEPS):
        start_pairs(first, estimate, registers)
        project(room.pairs, first, estimate, registers)
        if _move_one(sums, count, estimate, registers) < SMALL:
            break
    start_pairs(first, estimate, registers)
    subtract_one(flat_x, flat_y, weights, estimate, room)


@inner
@summing_kernel
def _look_up(overlaps: Floats, pair: Floats, registers: Singles) -> None:
    """Write C, T and K from their series about the nearest entry of the table."""
    per_entry = (overlaps.shape[0] - 1) / pi
    entry = 1.0 / per_entry
    for j in range(LANES):
        d = pair[OMEGA + j] - pair[SIZE + OMEGA + j]
        d -= 2.0 * pi * np.rint(d * (0.5 / pi))
        pair[_BETWEEN + j] = d
        place = np.rint(min(abs(d), pi) * per_entry)
        registers[ENTRY + j] = place
        pair[_OFF + j] = abs(d) - place * entry
    # What is looked up is looked up by itself: the loops that compute are then vectorised.
    for j in range(LANES):
        k = np.uint32(registers[ENTRY + j])
        pair[_OVER + j] = overlaps[k, 0]
        pair[_SHIFT + j] = overlaps[k, 1]
        pair[_CURVE + j] = overlaps[k, 2]
        pair[_THIRD + j] = overlaps[k, 3]
        pair[_FOURTH + j] = overlaps[k, 4]
    for j in range(LANES):
        over, shift, curve, e = pair[_OVER + j], pair[_SHIFT + j], pair[_CURVE + j], pair[_OFF + j]
        third, fourth = pair[_THIRD + j], pair[_FOURTH + j]
        pair[_OVER + j] = over - e * (shift + 0.5 * e * (curve - e * third * (1.0 / 3.0)))
        shift += e * (curve - 0.5 * e * (third + e * fourth * (1.0 / 3.0)))
        pair[_SHIFT + j] = shift if pair[_BETWEEN + j] > 0.0 else -shift
        pair[_CURVE + j] = curve - e * (third + 0.5 * e * fourth)


@inner
@summing_kernel
def _move_two(sums: Sums, s: float, pair: Floats, registers: Singles) -> None:
    """Solve the normal equations for a step of both returns, omega by half a bin at most, and go there."""
    v, vtt, per_s = sums.v, sums.vtt, 1.0 / s
    for j in range(LANES):
        over, shift, curve = pair[_OVER + j], pair[_SHIFT + j], pair[_CURVE + j]
        a, b = pair[AMPLITUDE + j], pair[SIZE + AMPLITUDE + j]
        # What the model leaves of the sums.
        h1 = np.float64(registers[IN_PHASE + j]) - a * v - b * over
        h2 = np.float64(registers[REGISTERS + IN_PHASE + j]) - a * over - b * v
        q1 = np.float64(registers[IN_QUADRATURE + j]) + b * shift
        q2 = np.float64(registers[REGISTERS + IN_QUADRATURE + j]) - a * shift
        even = 0.5 / max((v - over) * (vtt + curve) - shift * shift, 1e-6 * v * vtt)
        odd = 0.5 / max((v + over) * (vtt - curve) - shift * shift, 1e-6 * v * vtt)
        along = ((v - over) * (q1 + q2) - shift * (h1 - h2)) * even
        apart = ((v + over) * (q1 - q2) + shift * (h1 + h2)) * odd
        less = ((vtt + curve) * (h1 - h2) - shift * (q1 + q2)) * even
        more = ((vtt - curve) * (h1 + h2) + shift * (q1 - q2)) * odd
        pair[GAIN + j] = (more + less) * h1 + (more - less) * h2 + (along + apart) * q1 + (along - apart) * q2
        one, two = s * (along + apart) / max(a, 1e-30), s * (along - apart) / max(b, 1e-30)
        largest = max(abs(one), abs(two))
        pair[STEP_TIMES_S + j] = largest
        part = min(1.0, min(_LONGEST, _BOLDEST * s * abs(pair[_BETWEEN + j])) / max(largest, 1e-30))
        one, two, along, apart = part * one, part * two, part * along, part * apart
        # The amplitudes that are best where omega goes to.
        less = 0.5 * (h1 - h2 - 2.0 * shift * along) / max(v - over, 1e-6 * v)
        more = 0.5 * (h1 + h2 + 2.0 * shift * apart) / max(v + over, 1e-6 * v)
        pair[OMEGA + j] += one * per_s
        pair[SIZE + OMEGA + j] += two * per_s
        pair[AMPLITUDE + j] += more + less
        pair[SIZE + AMPLITUDE + j] += more - less


@inner
@summing_kernel
def _write_variance(sums: Sums, pair: Floats) -> None:
    """Write the variance of a_i omega_i for unit noise."""
    v, vtt = sums.v, sums.vtt
    for j in range(LANES):
        over, shift, curve = pair[_OVER + j], pair[_SHIFT + j], pair[_CURVE + j]
        even = 0.5 / max((v - over) * (vtt + curve) - shift * shift, 1e-6 * v * vtt)
        odd = 0.5 / max((v + over) * (vtt - curve) - shift * shift, 1e-6 * v * vtt)
        pair[VARIANCE + j] = (v - over) * even + (v + over) * odd


@inner
@summing_kernel
def is_done(step_times_s: float, gain: float, variance: float) -> bool:
    """Tell whether a step of two returns was the last one that a pixel needs."""
    return bool(step_times_s < _DONE or gain < _NEGLIGIBLE * variance)


@inner
@summing_kernel
def _expect_alone(sums: Sums, pair: Floats, registers: Singles) -> None:
    """Write the sums of a return where it fits alone, but for the small last step that is left of that."""
    for j in range(LANES):
        registers[IN_PHASE + j] = sums.v * pair[AMPLITUDE + j]
        registers[IN_QUADRATURE + j] = 0.0


@inner
@summing_kernel
def fit_two(
    x: Singles,
    y: Singles,
    count: int,
    first: int,
    weights: Weights,
    sums: Sums,
    overlaps: Floats,
    steps: int,
    alone: bool,
    active: Mask,
    variance: Floats,
    pair: Floats,
    room: Room,
) -> None:
    """Fit two returns to every pixel of a batch, until the active ones do not move.

    Parameters
    ----------
    overlaps
        Of `overlap_table`.
    steps
        Most steps.
    alone
        Whether the first return starts where `fit_one` left it: its sums are known, and the first step is not
        the last.
    active, variance
        (LANES,): which pixels matter, and the variance of their z.
    pair
        (PAIR_SIZE,): omega and amplitude of both returns are the start, and become the end; written are for
        both what `fit_one` writes, but the larger step and the sum of squares for the first alone; the last
        step's gain in chi-square, and the variance of a_i omega_i for unit noise.
    room
        With the pairs of the signals, by `write_pairs` or left behind by `fit_one`; what both returns leave
        of the signals is left behind there.

    The other parameters are those of `fit_one`.
    """
    registers, pairs = room.registers, room.pairs
    one, two = pair[:SIZE], pair[SIZE : 2 * SIZE]
    sums_of_one, sums_of_two = registers[:REGISTERS], registers[REGISTERS:]
    for step in range(steps):
        start_pairs(first, two, sums_of_two)
        if alone and step == 0:
            _expect_alone(sums, pair, registers)
            project(pairs, first, two, sums_of_two)
        else:
            start_pairs(first, one, sums_of_one)
            project_two(pairs, first, pair, registers)
        _look_up(overlaps, pair, registers)
        _move_two(sums, count, pair, registers)
        moving = 0
        for j in range(LANES):
            if active[j] and not is_done(pair[STEP_TIMES_S + j], pair[GAIN + j], variance[j]):
                moving += 1
        if moving == 0 and not (alone and step == 0):
            break
    start_pairs(first, one, sums_of_one)
    start_pairs(first, two, sums_of_two)
    subtract_two(x.reshape(-1), y.reshape(-1), weights, pair, room)
    _look_up(overlaps, pair, registers)
    _write_variance(sums, pair)
