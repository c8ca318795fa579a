"""The sums over densities that the fits of a batch of pixels are made of, and what returns leave.

Sums over t are in single precision. Their exp(i omega t) run from group to group in double precision, so that
rounding does not grow with t. All sums go over pairs of densities m + k and m - k about the middle m of a
group, whose exp(i omega t) are sums and differences of the same four products. With S and D the sum and
difference of u z there, u z exp(-i omega t) sums to exp(-i omega m) (S cos k omega - i D sin k omega), which
takes less than half of what turning from t to t takes, and S and D are the same for every step.


What loops over the pixels of a batch read and write lies at constant places of few flat arrays: whether
others overlap is asked at every entry of such a loop, which can take longer than the loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import inlined, inner, summing_kernel
from sms_jobs.metrology.phase.ranging.transform import LANES
from sms_jobs.metrology.phase.ranging.weights import Weights

GROUP = 16  # densities about one middle

# Parts of the estimate of a return, `LANES` numbers each. It is flat, and the parts constants: only then does
# the compiler see that they do not overlap.
OMEGA = 0
AMPLITUDE = LANES
SQUARES = 2 * LANES  # of the residual, weighted
FALL = 3 * LANES  # Re sum u t^2 r exp(-i omega t) of the residual r
STEP_TIMES_S = 4 * LANES  # the last step of omega; what is left is its cube, or for two returns its square
COSINE = 5 * LANES  # the running exp(i omega t)
SINE = 6 * LANES
GROUP_COSINE = 7 * LANES  # what turns it by a group
GROUP_SINE = 8 * LANES
SIZE = 9 * LANES

_PAIRS = GROUP // 2
_AT_ONCE, _FEWER_AT_ONCE = 4, 2  # pairs, the latter of two returns; longer loops are not unrolled
_PARTS = 4  # of a pair: Re S, Im S, Re D, Im D

# Parts of the single-precision registers of a return: two sums, cos and sin of k omega, k = 1/2 .. 15/2, one
# after the other, and a place in a table.
IN_PHASE = 0
IN_QUADRATURE = LANES
_PAIR_COSINES = 2 * LANES
_PAIR_SINES = _PAIR_COSINES + _PAIRS * LANES
ENTRY = _PAIR_SINES + _PAIRS * LANES
REGISTERS = ENTRY + LANES


class Room(NamedTuple):
    """What the fits of a batch use.

    Attributes
    ----------
    registers
        Of two returns, (2 REGISTERS,).
    pairs
        Of `write_pairs`, flat.
    left_x, left_y
        What the fitted returns leave of the signals, flat.
    """

    registers: Singles
    pairs: Singles
    left_x: Singles
    left_y: Singles


@inner
@summing_kernel
def new_room(padded: int) -> Room:
    """Return room for the fits of a batch of so many densities, a multiple of `GROUP`."""
    return Room(
        np.zeros(2 * REGISTERS, np.float32),
        np.empty(2 * padded * LANES, np.float32),
        np.zeros(padded * LANES, np.float32),
        np.zeros(padded * LANES, np.float32),
    )


@inlined
def half_turn(angle: float) -> tuple[float, float]:
    """Return cos and sin of an angle in -pi / 2 .. pi / 2, from their series at half of it."""
    x = 0.5 * angle
    q = x * x
    s = 1.0 - q * (1 / 110) * (1.0 - q * (1 / 156) * (1.0 - q * (1 / 210)))
    s = x * (1.0 - q * (1 / 6) * (1.0 - q * (1 / 20) * (1.0 - q * (1 / 42) * (1.0 - q * (1 / 72) * s))))
    c = 1.0 - q * (1 / 90) * (1.0 - q * (1 / 132) * (1.0 - q * (1 / 182) * (1.0 - q * (1 / 240))))
    c = 1.0 - q * 0.5 * (1.0 - q * (1 / 12) * (1.0 - q * (1 / 30) * (1.0 - q * (1 / 56) * c)))
    return c * c - s * s, 2.0 * c * s


@inner
@summing_kernel
def turn_by_group(estimate: Floats) -> None:
    """Turn the running exp(i omega t) by a group of densities."""
    for j in range(LANES):
        c, s = estimate[COSINE + j], estimate[SINE + j]
        estimate[COSINE + j] = c * estimate[GROUP_COSINE + j] - s * estimate[GROUP_SINE + j]
        estimate[SINE + j] = s * estimate[GROUP_COSINE + j] + c * estimate[GROUP_SINE + j]


@inner
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


@inner
@summing_kernel
def start_pairs(first: int, estimate: Floats, registers: Singles) -> None:
    """Set exp(i omega t) to the middle of the first group, and exp(i omega k) of its pairs; sums to 0.

    Rounding of the latter turns the two densities of a pair against each other, and omega by nothing.
    """
    for j in range(LANES):
        half_c, half_s = half_turn(0.5 * estimate[OMEGA + j])
        c, s = half_c * half_c - half_s * half_s, 2.0 * half_c * half_s
        p, q, turn_p, turn_q = np.float32(half_c), np.float32(half_s), np.float32(c), np.float32(s)
        for k in range(_PAIRS):
            registers[_PAIR_COSINES + k * LANES + j] = p
            registers[_PAIR_SINES + k * LANES + j] = q
            p, q = p * turn_p - q * turn_q, q * turn_p + p * turn_q
        for _ in range(3):
            c, s = c * c - s * s, 2.0 * c * s
        back = half_s if first == 0 else -half_s  # from 8 omega to the middle, 15/2 or 17/2
        estimate[COSINE + j] = c * half_c + s * back
        estimate[SINE + j] = s * half_c - c * back
        estimate[GROUP_COSINE + j] = c * c - s * s
        estimate[GROUP_SINE + j] = 2.0 * c * s
        registers[IN_PHASE + j] = 0.0
        registers[IN_QUADRATURE + j] = 0.0


@inlined
def _add_pairs(
    pairs: Singles,
    start: int,
    skipped: int,
    middle: np.float32,
    estimate: Floats,
    e: int,
    registers: Singles,
    r: int,
) -> None:
    """Add `_AT_ONCE` pairs of a group, behind those that are skipped, to the sums of one lane of a return.

    `start` is where they are, `e` and `r` where its estimate and its registers are.
    """
    re, im, near_re, near_im = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    far_re, far_im = np.float32(0.0), np.float32(0.0)
    for n in range(_AT_ONCE):
        k = _AT_ONCE - 1 - n
        p = np.uint64(start + k * _PARTS * LANES)
        turn = r + (skipped + k) * LANES
        c, s = registers[turn + _PAIR_COSINES], registers[turn + _PAIR_SINES]
        sum_re, sum_im = pairs[p], pairs[p + np.uint64(LANES)]
        off_re, off_im = pairs[p + np.uint64(2 * LANES)], pairs[p + np.uint64(3 * LANES)]
        re += sum_re * c + off_im * s
        im += sum_im * c - off_re * s
        near_re += off_re * c + sum_im * s
        near_im += off_im * c - sum_re * s
        # Sums of sums are those of k + 1 times what is added at k.
        far_re += near_re
        far_im += near_im
    off = np.float32(skipped - 0.5)
    far_re += off * near_re
    far_im += off * near_im
    c, s = np.float32(estimate[e + COSINE]), np.float32(estimate[e + SINE])
    registers[r + IN_PHASE] += re * c + im * s
    registers[r + IN_QUADRATURE] += (middle * im + far_im) * c - (middle * re + far_re) * s


@inner
@summing_kernel
def project(pairs: Singles, first: int, estimate: Floats, registers: Singles) -> None:
    """Sum Re u z exp(-i omega t) and Im u t z exp(-i omega t) from the pairs of `write_pairs`."""
    for group in range(pairs.size // (2 * GROUP * LANES)):
        middle = np.float32(first + group * GROUP + 0.5 * (GROUP - 1))
        start = group * GROUP * 2 * LANES
        far = start + _AT_ONCE * _PARTS * LANES
        for j in range(LANES):
            _add_pairs(pairs, start + j, 0, middle, estimate, j, registers, j)
        for j in range(LANES):
            _add_pairs(pairs, far + j, _AT_ONCE, middle, estimate, j, registers, j)
        turn_by_group(estimate)


@inner
@summing_kernel
def project_two(pairs: Singles, first: int, pair: Floats, registers: Singles) -> None:
    """Do what `project` does for both returns, reading the pairs once."""
    one, two = pair[:SIZE], pair[SIZE : 2 * SIZE]
    for group in range(pairs.size // (2 * GROUP * LANES)):
        middle = np.float32(first + group * GROUP + 0.5 * (GROUP - 1))
        start = group * GROUP * 2 * LANES
        far = start + _AT_ONCE * _PARTS * LANES
        for j in range(LANES):
            _add_pairs(pairs, start + j, 0, middle, pair, j, registers, j)
            _add_pairs(pairs, start + j, 0, middle, pair, SIZE + j, registers, REGISTERS + j)
        for j in range(LANES):
            _add_pairs(pairs, far + j, _AT_ONCE, middle, pair, j, registers, j)
            _add_pairs(pairs, far + j, _AT_ONCE, middle, pair, SIZE + j, registers, REGISTERS + j)
        turn_by_group(one)
        turn_by_group(two)


@inlined
def _leave_of_one(
    x: Singles, y: Singles, weights: Weights, estimate: Floats, room: Room, start: int, k: int
) -> None:
    """Write what a return leaves of `_AT_ONCE` pairs, from the k-th on, of the group from density `start` on.

    The rotors have the amplitude in them, and so has the fall. A k that is counted in a loop would be taken
    for one whose pairs overlap.
    """
    transfer, precision, u = weights.transfer, weights.precision, weights.u
    registers, left_x, left_y = room.registers, room.left_x, room.left_y
    row = np.uint64(start * LANES)
    for j in range(LANES):
        a = estimate[AMPLITUDE + j]
        c, s = np.float32(a * estimate[COSINE + j]), np.float32(a * estimate[SINE + j])
        squares, fall = np.float32(0.0), np.float32(0.0)
        for n in range(_AT_ONCE):
            low, high = _PAIRS - 1 - k - n, _PAIRS + k + n
            p = registers[_PAIR_COSINES + (k + n) * LANES + j]
            q = registers[_PAIR_SINES + (k + n) * LANES + j]
            cp, sq, cq, sp = c * p, s * q, c * q, s * p
            above_c, above_s, below_c, below_s = cp - sq, cq + sp, cp + sq, sp - cq
            i, o = row + np.uint64(high * LANES + j), row + np.uint64(low * LANES + j)
            f, g = transfer[start + high], transfer[start + low]
            re, im = x[i] - f * above_c, y[i] - f * above_s
            left_x[i], left_y[i] = re, im
            squares += precision[start + high] * (re * re + im * im)
            fall += u[2, start + high] * (re * above_c + im * above_s)
            re, im = x[o] - g * below_c, y[o] - g * below_s
            left_x[o], left_y[o] = re, im
            squares += precision[start + low] * (re * re + im * im)
            fall += u[2, start + low] * (re * below_c + im * below_s)
        registers[IN_PHASE + j] += squares
        registers[IN_QUADRATURE + j] += fall


@inner
@summing_kernel
def subtract_one(x: Singles, y: Singles, weights: Weights, estimate: Floats, room: Room) -> None:
    """Write what a return leaves of signals, which are flat; sum squares and fall of that."""
    registers = room.registers
    for start in range(0, x.size // LANES, GROUP):
        _leave_of_one(x, y, weights, estimate, room, start, 0)
        _leave_of_one(x, y, weights, estimate, room, start, _AT_ONCE)
        turn_by_group(estimate)
    for j in range(LANES):
        estimate[SQUARES + j] = registers[IN_PHASE + j]
        estimate[FALL + j] = registers[IN_QUADRATURE + j] / max(estimate[AMPLITUDE + j], 1e-30)


@inlined
def _leave_of_two(
    x: Singles, y: Singles, weights: Weights, pair: Floats, room: Room, start: int, k: int
) -> None:
    """Do what `_leave_of_one` does for both returns, at fewer pairs; the squares are those of the first."""
    transfer, precision, u = weights.transfer, weights.precision, weights.u
    registers, left_x, left_y = room.registers, room.left_x, room.left_y
    row = np.uint64(start * LANES)
    for j in range(LANES):
        a, b = pair[AMPLITUDE + j], pair[SIZE + AMPLITUDE + j]
        c, s = np.float32(a * pair[COSINE + j]), np.float32(a * pair[SINE + j])
        d, e = np.float32(b * pair[SIZE + COSINE + j]), np.float32(b * pair[SIZE + SINE + j])
        squares, fall, other_fall = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for n in range(_FEWER_AT_ONCE):
            low, high = _PAIRS - 1 - k - n, _PAIRS + k + n
            p = registers[_PAIR_COSINES + (k + n) * LANES + j]
            q = registers[_PAIR_SINES + (k + n) * LANES + j]
            v = registers[REGISTERS + _PAIR_COSINES + (k + n) * LANES + j]
            w = registers[REGISTERS + _PAIR_SINES + (k + n) * LANES + j]
            cp, sq, cq, sp = c * p, s * q, c * q, s * p
            dv, ew, dw, ev = d * v, e * w, d * w, e * v
            one_c, one_s, two_c, two_s = cp - sq, cq + sp, dv - ew, dw + ev
            i = row + np.uint64(high * LANES + j)
            re = x[i] - transfer[start + high] * (one_c + two_c)
            im = y[i] - transfer[start + high] * (one_s + two_s)
            left_x[i], left_y[i] = re, im
            squares += precision[start + high] * (re * re + im * im)
            fall += u[2, start + high] * (re * one_c + im * one_s)
            other_fall += u[2, start + high] * (re * two_c + im * two_s)
            one_c, one_s, two_c, two_s = cp + sq, sp - cq, dv + ew, ev - dw
            o = row + np.uint64(low * LANES + j)
            re = x[o] - transfer[start + low] * (one_c + two_c)
            im = y[o] - transfer[start + low] * (one_s + two_s)
            left_x[o], left_y[o] = re, im
            squares += precision[start + low] * (re * re + im * im)
            fall += u[2, start + low] * (re * one_c + im * one_s)
            other_fall += u[2, start + low] * (re * two_c + im * two_s)
        pair[SQUARES + j] += squares
        pair[FALL + j] += fall
        pair[SIZE + FALL + j] += other_fall


@inner
@summing_kernel
def subtract_two(x: Singles, y: Singles, weights: Weights, pair: Floats, room: Room) -> None:
    """Do what `subtract_one` does for both returns at once; the squares are those of the first."""
    one, two = pair[:SIZE], pair[SIZE : 2 * SIZE]
    for j in range(LANES):
        pair[SQUARES + j], pair[FALL + j], pair[SIZE + FALL + j] = 0.0, 0.0, 0.0
    for start in range(0, x.size // LANES, GROUP):
        _leave_of_two(x, y, weights, pair, room, start, 0)
        _leave_of_two(x, y, weights, pair, room, start, _FEWER_AT_ONCE)
        _leave_of_two(x, y, weights, pair, room, start, 2 * _FEWER_AT_ONCE)
        _leave_of_two(x, y, weights, pair, room, start, 3 * _FEWER_AT_ONCE)
        turn_by_group(one)
        turn_by_group(two)
    for j in range(LANES):
        pair[FALL + j] /= max(pair[AMPLITUDE + j], 1e-30)
        pair[SIZE + FALL + j] /= max(pair[SIZE + AMPLITUDE + j], 1e-30)
