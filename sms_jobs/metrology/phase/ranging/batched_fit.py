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

Sums over t are in single precision. Their exp(i omega t) run from group to group in double precision, so that
rounding does not grow with t. The sums that a fit repeats go over pairs of densities m + k and m - k about
the middle m of a group: with S and D the sum and difference of u z there, u z exp(-i omega t) sums to
exp(-i omega m) (S cos k omega - i D sin k omega), which takes less than half of what turning from t to t
takes, and S and D are the same for every step.
"""

from __future__ import annotations

from math import pi

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import inlined, summing_kernel
from sms_jobs.metrology.phase.ranging.transform import LANES
from sms_jobs.metrology.phase.ranging.weights import Sums, Weights

GROUP = 8  # densities that are summed together; longer loops are not unrolled

# Parts of the estimate of a return, `LANES` numbers each. It is flat, and the parts constants: only then does
# the compiler see that they do not overlap.
OMEGA = 0
AMPLITUDE = LANES
SQUARES = 2 * LANES  # of the residual, weighted
FALL = 3 * LANES  # Re sum u t^2 r exp(-i omega t) of the residual r
STEP_TIMES_S = 4 * LANES  # the last step of omega; what is left is its cube, or for two returns its square
COSINE = 5 * LANES  # the running exp(i omega t)
SINE = 6 * LANES
_GROUP_COSINE = 7 * LANES  # what turns it by a group
_GROUP_SINE = 8 * LANES
SIZE = 9 * LANES

# Parts of the estimate of two returns, behind those of both: the last step's gain in chi-square, the variance
# of a_i omega_i for unit noise, and C, T, K, d.
GAIN = 2 * SIZE
VARIANCE = 2 * SIZE + LANES
_OVER = 2 * SIZE + 2 * LANES
_SHIFT = 2 * SIZE + 3 * LANES
_CURVE = 2 * SIZE + 4 * LANES
_BETWEEN = 2 * SIZE + 5 * LANES
PAIR_SIZE = 2 * SIZE + 6 * LANES

# Parts of the single-precision registers of a return: what turns exp(i omega t) by one, the amplitude, sums.
TURN_COSINE = 0
TURN_SINE = LANES
_SCALE = 2 * LANES
_IN_PHASE = 3 * LANES
_IN_QUADRATURE = 4 * LANES
_PAIR_COSINES = 5 * LANES  # cos and sin of k omega, k = 1/2 .. 7/2, one after the other
_PAIR_SINES = 9 * LANES
REGISTERS = 13 * LANES

_PAIRS = GROUP // 2
_PARTS = 4  # of a pair: Re S, Im S, Re D, Im D

SMALL = 0.1  # step of omega of one return, times s, after which the cube of it that is left does not matter

_STEPS = 3
_LONGEST = 3.0  # step x s: half a bin
_BOLDEST = 0.4  # step over the distance of both returns, beyond which the linear model says little
_DONE = 0.01  # step x s of two returns after which no further one is needed: what is left is its square
_NEGLIGIBLE = 1e-2  # gain in chi-square that is not worth another step
_FINENESS = 128  # entries of the table a bin: what interpolation misses is 3e-7 of the sums


def overlap_table(densities: Floats, v: Floats) -> Floats:
    """Return C, T, K and sum v t^4 cos dt for d = 0 .. pi, (entries, 4), from v of every density."""
    half = _FINENESS << max(int(densities[-1]).bit_length() - 1, 1)
    rows = np.zeros((4, int(densities[-1]) + 1))
    rows[:, densities.astype(np.int64)] = v, v * densities, v * densities**2, v * densities**4
    spectra = np.fft.rfft(rows, 2 * half, axis=1)
    table = np.zeros((half + 2, 4))
    table[: half + 1] = np.stack(
        [spectra[0].real, -spectra[1].imag, spectra[2].real, spectra[3].real], axis=1
    )
    table[half + 1] = table[half]
    return table


@inlined
def _half_turn(angle: float) -> tuple[float, float]:
    """Return cos and sin of an angle in -pi / 2 .. pi / 2, from their series at half of it."""
    x = 0.5 * angle
    q = x * x
    s = 1.0 - q * (1 / 110) * (1.0 - q * (1 / 156) * (1.0 - q * (1 / 210)))
    s = x * (1.0 - q * (1 / 6) * (1.0 - q * (1 / 20) * (1.0 - q * (1 / 42) * (1.0 - q * (1 / 72) * s))))
    c = 1.0 - q * (1 / 90) * (1.0 - q * (1 / 132) * (1.0 - q * (1 / 182) * (1.0 - q * (1 / 240))))
    c = 1.0 - q * 0.5 * (1.0 - q * (1 / 12) * (1.0 - q * (1 / 30) * (1.0 - q * (1 / 56) * c)))
    return c * c - s * s, 2.0 * c * s


@summing_kernel
def start_rotors(first: int, estimate: Floats, registers: Singles) -> None:
    """Set exp(i omega t) to the first density, and what turns it; set the sums to 0."""
    for j in range(LANES):
        c, s = _half_turn(0.5 * estimate[OMEGA + j])
        c, s = c * c - s * s, 2.0 * c * s
        estimate[COSINE + j] = 1.0 if first == 0 else c
        estimate[SINE + j] = 0.0 if first == 0 else s
        registers[TURN_COSINE + j] = c
        registers[TURN_SINE + j] = s
        registers[_SCALE + j] = estimate[AMPLITUDE + j]
        registers[_IN_PHASE + j] = 0.0
        registers[_IN_QUADRATURE + j] = 0.0
        for _ in range(3):
            c, s = c * c - s * s, 2.0 * c * s
        estimate[_GROUP_COSINE + j] = c
        estimate[_GROUP_SINE + j] = s


@summing_kernel
def turn_by_group(estimate: Floats) -> None:
    """Turn the running exp(i omega t) by a group of densities."""
    for j in range(LANES):
        c, s = estimate[COSINE + j], estimate[SINE + j]
        estimate[COSINE + j] = c * estimate[_GROUP_COSINE + j] - s * estimate[_GROUP_SINE + j]
        estimate[SINE + j] = s * estimate[_GROUP_COSINE + j] + c * estimate[_GROUP_SINE + j]


@summing_kernel
def write_pairs(x: Singles, y: Singles, u: Singles, pairs: Singles) -> None:
    """Write sums and differences of u z for densities that lie alike about the middle of their group.

    All are flat but `u`, the weight of every density; `pairs` has room for 2 (densities, LANES).
    """
    for t in range(0, x.size // LANES, GROUP):
        for k in range(_PAIRS):
            low, high = t + _PAIRS - 1 - k, t + _PAIRS + k
            below, above = u[low], u[high]
            for j in range(LANES):
                # An unsigned index needs no look at its sign, which would keep this from being vectorised.
                i, o = np.uint64(low * LANES + j), np.uint64(high * LANES + j)
                p = np.uint64((t // GROUP * _PAIRS + k) * _PARTS * LANES + j)
                re, im, other_re, other_im = above * x[o], above * y[o], below * x[i], below * y[i]
                pairs[p] = re + other_re
                pairs[p + np.uint64(LANES)] = im + other_im
                pairs[p + np.uint64(2 * LANES)] = re - other_re
                pairs[p + np.uint64(3 * LANES)] = im - other_im


@summing_kernel
def _start_pairs(first: int, estimate: Floats, registers: Singles) -> None:
    """Set exp(i omega t) to the middle of the first group, and exp(i omega k) of its pairs; sums to 0."""
    for j in range(LANES):
        c, s = _half_turn(0.5 * estimate[OMEGA + j])
        turn_c, turn_s = c * c - s * s, 2.0 * c * s
        for k in range(_PAIRS):
            registers[_PAIR_COSINES + k * LANES + j] = c
            registers[_PAIR_SINES + k * LANES + j] = s
            if k < _PAIRS - 1 or first == 1:
                c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        estimate[COSINE + j] = c
        estimate[SINE + j] = s
        for _ in range(3):
            turn_c, turn_s = turn_c * turn_c - turn_s * turn_s, 2.0 * turn_c * turn_s
        estimate[_GROUP_COSINE + j] = turn_c
        estimate[_GROUP_SINE + j] = turn_s
        registers[_IN_PHASE + j] = 0.0
        registers[_IN_QUADRATURE + j] = 0.0


@summing_kernel
def _project(pairs: Singles, groups: int, first: int, estimate: Floats, registers: Singles) -> None:
    """Sum Re u z exp(-i omega t) and Im u t z exp(-i omega t) from the pairs of `write_pairs`."""
    for group in range(groups):
        middle = np.float32(first + group * GROUP + 0.5 * (GROUP - 1))
        for j in range(LANES):
            re, im, far_re, far_im = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(_PAIRS):
                p = np.uint64((group * _PAIRS + k) * _PARTS * LANES + j)
                c, s = registers[_PAIR_COSINES + k * LANES + j], registers[_PAIR_SINES + k * LANES + j]
                sum_re, sum_im = pairs[p], pairs[p + np.uint64(LANES)]
                off_re, off_im = pairs[p + np.uint64(2 * LANES)], pairs[p + np.uint64(3 * LANES)]
                re += sum_re * c + off_im * s
                im += sum_im * c - off_re * s
                c, s = c * np.float32(k + 0.5), s * np.float32(k + 0.5)
                far_re += off_re * c + sum_im * s
                far_im += off_im * c - sum_re * s
            c, s = np.float32(estimate[COSINE + j]), np.float32(estimate[SINE + j])
            registers[_IN_PHASE + j] += re * c + im * s
            registers[_IN_QUADRATURE + j] += (middle * im + far_im) * c - (middle * re + far_re) * s
        turn_by_group(estimate)


@summing_kernel
def _subtract(x: Singles, y: Singles, weights: Weights, estimate: Floats, registers: Singles) -> None:
    """Take a return out of signals, which are flat; sum squares and fall of what is left."""
    transfer, precision, u = weights.transfer, weights.precision, weights.u
    for t in range(0, x.size // LANES, GROUP):
        for j in range(LANES):
            c, s = np.float32(estimate[COSINE + j]), np.float32(estimate[SINE + j])
            p, q, a = registers[TURN_COSINE + j], registers[TURN_SINE + j], registers[_SCALE + j]
            squares, fall = np.float32(0.0), np.float32(0.0)
            for k in range(GROUP):
                # An unsigned index needs no look at its sign, which would keep this from being vectorised.
                i = np.uint64((t + k) * LANES + j)
                re = x[i] - transfer[t + k] * a * c
                im = y[i] - transfer[t + k] * a * s
                x[i], y[i] = re, im
                squares += precision[t + k] * (re * re + im * im)
                fall += u[2, t + k] * (re * c + im * s)
                c, s = c * p - s * q, s * p + c * q
            registers[_IN_PHASE + j] += squares
            registers[_IN_QUADRATURE + j] += fall
        turn_by_group(estimate)
    for j in range(LANES):
        estimate[SQUARES + j] = registers[_IN_PHASE + j]
        estimate[FALL + j] = registers[_IN_QUADRATURE + j]


@summing_kernel
def _move_one(sums: Sums, s: float, estimate: Floats, registers: Singles) -> float:
    """Turn the sums into amplitude and step of omega, half a bin at most; return the largest step times s."""
    per_v, per_s, lever = 1.0 / sums.v, 1.0 / s, s / sums.vtt
    for j in range(LANES):
        slope = np.float64(registers[_IN_QUADRATURE + j])
        a = registers[_IN_PHASE + j] * per_v
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


@summing_kernel
def fit_one(
    x: Singles,
    y: Singles,
    count: int,
    first: int,
    weights: Weights,
    sums: Sums,
    estimate: Floats,
    registers: Singles,
    pairs: Singles,
) -> None:
    """Fit one return to every pixel of a batch.

    Parameters
    ----------
    x, y
        z(t), (densities, LANES), 0 beyond `count` up to a multiple of `GROUP`; become what the return leaves.
    count, first
        Number of densities, and t of the first one.
    weights, sums
        Of pixels that no density is left out of.
    estimate
        (SIZE,): omega is the start, and becomes the end; amplitude, squares, fall and step are written.
    registers, pairs
        Scratch, (REGISTERS,) and (2 x.size,); `pairs` becomes those of the signal.
    """
    flat_x, flat_y = x.reshape(-1), y.reshape(-1)
    write_pairs(flat_x, flat_y, weights.u[0], pairs)
    for _ in range(_STEPS):
        _start_pairs(first, estimate, registers)
        _project(pairs, x.shape[0] // GROUP, first, estimate, registers)
        if _move_one(sums, count, estimate, registers) < SMALL:
            break
    start_rotors(first, estimate, registers)
    _subtract(flat_x, flat_y, weights, estimate, registers)


@summing_kernel
def _look_up(overlaps: Floats, pair: Floats) -> None:
    """Interpolate C, T and K in the table, linearly but for their known curvature."""
    last = np.uint32(overlaps.shape[0] - 2)
    per_entry = last / pi
    entry = 1.0 / per_entry
    for j in range(LANES):
        d = pair[OMEGA + j] - pair[SIZE + OMEGA + j]
        d -= 2.0 * pi * np.rint(d * (0.5 / pi))
        pair[_BETWEEN + j] = d
        place = min(abs(d), pi) * per_entry
        k = min(np.uint32(place), last)
        part = place - np.float64(k)
        after = k + np.uint32(1)
        # C'' = -K, T'' = dK/dd, K'' = -sum v t^4 cos dt.
        bow = 0.5 * part * (1.0 - part) * entry
        change = overlaps[after, 2] - overlaps[k, 2]
        curve = overlaps[k, 2] + part * change
        shift = overlaps[k, 1] + part * (overlaps[after, 1] - overlaps[k, 1]) - bow * change
        over = overlaps[k, 0] + part * (overlaps[after, 0] - overlaps[k, 0])
        pair[_OVER + j] = over + bow * entry * curve
        pair[_SHIFT + j] = shift if d > 0.0 else -shift
        fourth = overlaps[k, 3] + part * (overlaps[after, 3] - overlaps[k, 3])
        pair[_CURVE + j] = curve + bow * entry * fourth


@summing_kernel
def _move_two(sums: Sums, s: float, pair: Floats, registers: Singles) -> None:
    """Solve the normal equations for a step of both returns, omega by half a bin at most, and go there."""
    v, vtt, per_s = sums.v, sums.vtt, 1.0 / s
    for j in range(LANES):
        over, shift, curve = pair[_OVER + j], pair[_SHIFT + j], pair[_CURVE + j]
        a, b = pair[AMPLITUDE + j], pair[SIZE + AMPLITUDE + j]
        # What the model leaves of the sums.
        h1 = np.float64(registers[_IN_PHASE + j]) - a * v - b * over
        h2 = np.float64(registers[REGISTERS + _IN_PHASE + j]) - a * over - b * v
        q1 = np.float64(registers[_IN_QUADRATURE + j]) + b * shift
        q2 = np.float64(registers[REGISTERS + _IN_QUADRATURE + j]) - a * shift
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


@summing_kernel
def _finish_two(sums: Sums, pair: Floats) -> None:
    """Write the variance of a_i omega_i for unit noise; take the second return from the first one's fall."""
    v, vtt = sums.v, sums.vtt
    for j in range(LANES):
        over, shift, curve = pair[_OVER + j], pair[_SHIFT + j], pair[_CURVE + j]
        even = 0.5 / max((v - over) * (vtt + curve) - shift * shift, 1e-6 * v * vtt)
        odd = 0.5 / max((v + over) * (vtt - curve) - shift * shift, 1e-6 * v * vtt)
        pair[VARIANCE + j] = (v - over) * even + (v + over) * odd
        pair[SQUARES + j] = pair[SIZE + SQUARES + j]
        pair[FALL + j] -= pair[SIZE + AMPLITUDE + j] * curve


@summing_kernel
def is_done(step_times_s: float, gain: float, variance: float) -> bool:
    """Tell whether a step of two returns was the last one that a pixel needs."""
    return bool(step_times_s < _DONE or gain < _NEGLIGIBLE * variance)


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
    active: Mask,
    variance: Floats,
    pair: Floats,
    registers: Singles,
    pairs: Singles,
) -> None:
    """Fit two returns to every pixel of a batch, until the active ones do not move.

    Parameters
    ----------
    overlaps
        Of `overlap_table`.
    steps
        Most steps.
    active, variance
        (LANES,): which pixels matter, and the variance of their z.
    pair
        (PAIR_SIZE,): omega and amplitude of both returns are the start, and become the end; written are for
        both what `fit_one` writes, but the larger step and the sum of squares for the first alone; the last
        step's gain in chi-square, and the variance of a_i omega_i for unit noise.
    registers
        Scratch, (2 REGISTERS,).
    pairs
        Of the signals, by `write_pairs` or left behind by `fit_one`.

    The other parameters are those of `fit_one`.
    """
    returns = ((pair[:SIZE], registers[:REGISTERS]), (pair[SIZE : 2 * SIZE], registers[REGISTERS:]))
    for _ in range(steps):
        for estimate, sums_of_one in returns:
            _start_pairs(first, estimate, sums_of_one)
            _project(pairs, x.shape[0] // GROUP, first, estimate, sums_of_one)
        _look_up(overlaps, pair)
        _move_two(sums, count, pair, registers)
        moving = 0
        for j in range(LANES):
            if active[j] and not is_done(pair[STEP_TIMES_S + j], pair[GAIN + j], variance[j]):
                moving += 1
        if moving == 0:
            break
    for estimate, sums_of_one in returns:
        start_rotors(first, estimate, sums_of_one)
        _subtract(x.reshape(-1), y.reshape(-1), weights, estimate, sums_of_one)
    _look_up(overlaps, pair)
    _finish_two(sums, pair)
