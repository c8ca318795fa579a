"""The least squares of two returns whose amplitudes were observed elsewhere, pixel by pixel.

A solution is (4,): two omega, then their amplitudes. Sums over t are in single precision.
"""

from __future__ import annotations

from math import log, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Singles
from sms_jobs.metrology.compilation import inner, uncounted_summing_kernel
from sms_jobs.metrology.phase.ranging.reference_fit import factorize, substitute, write_rotors

DECIDED = 2.0 * log(1e4)  # in chi-square: odds of 10^4, as of fringe orders

_AT_ONCE = 16  # pixels: of single precision a line of the cache
_STEPS = 20
_NEGLIGIBLE = 1e-3  # gain in chi-square that is not worth another step
_ROUNDING = 1.0 + 1e-5  # of chi-square
_EASIER, _HARDER, _DAMPING = 0.2, 10.0, 1e-3
_SHORT = 0.1  # of the longest step: one that gains nothing leads nowhere else


class Model(NamedTuple):
    """What two returns show.

    Attributes
    ----------
    densities, transfer
        t, one after the other, and the modulation there relative to that towards t = 0, (densities,).
    orders, forward, backward
        Of `Ghosts`.
    apart, cosines
        Distances to start from, in rad, and cos of them times t: (distances,), (distances, densities).
    """

    densities: Singles
    transfer: Singles
    orders: Floats
    forward: Singles
    backward: Singles
    apart: Floats
    cosines: Singles


class Known(NamedTuple):
    """What is known of pixels before.

    Attributes
    ----------
    found
        Solutions without what is observed elsewhere, (n, 4), 0 for a return that was not found.
    told, told_sigma
        The observed amplitudes and their standard deviations, (n, 2).
    """

    found: Floats
    told: Floats
    told_sigma: Floats


class Solved(NamedTuple):
    """What the fits find.

    Attributes
    ----------
    solutions, misfits
        The solution of either side of the stronger return on which the weaker may lie, (n, 2, 4), and its
        chi-square with that of the amplitudes, (n, 2).
    sigma
        Standard deviations of both omega of the better, (n, 2), infinite where nothing tells them.
    without
        Chi-square of what was found before, (n,).
    """

    solutions: Floats
    misfits: Floats
    sigma: Floats
    without: Floats


class Room(NamedTuple):
    """What the fit of a pixel uses.

    Attributes
    ----------
    signal, left
        z, and what the returns leave of it, (2, densities): real and imaginary part.
    weight
        Inverse variance of either part of z, (densities,).
    turns
        cos and sin of omega t, (2, densities).
    columns
        Derivatives of z by both omega, for amplitude 1, and by both amplitudes, (4, 2, densities).
    normal, factor, slope, step, trial
        Of a step: (4, 4), (4, 4), (4,), (4,), (4,).
    block
        Signal and weight of some pixels that follow each other, (pixels, 3, densities).
    """

    signal: Singles
    left: Singles
    weight: Singles
    turns: Singles
    columns: Singles
    normal: Floats
    factor: Floats
    slope: Floats
    step: Floats
    trial: Floats
    block: Singles


def new_room(size: int) -> Room:
    """Return room for pixels of so many densities."""
    return Room(
        np.empty((2, size), np.float32),
        np.empty((2, size), np.float32),
        np.empty(size, np.float32),
        np.empty((2, size), np.float32),
        np.empty((4, 2, size), np.float32),
        np.zeros((4, 4)),
        np.zeros((4, 4)),
        np.zeros(4),
        np.zeros(4),
        np.zeros(4),
        np.empty((_AT_ONCE, 3, size), np.float32),
    )


@inner
@uncounted_summing_kernel
def _write_columns(omega: float, model: Model, by_omega: Singles, light: Singles, turns: Singles) -> None:
    """Write what a return of amplitude 1 shows, with its ghosts, and the derivative of that by omega."""
    densities, transfer = model.densities, model.transfer
    first = int(densities[0])
    write_rotors(omega, first, turns)
    for t in range(densities.size):
        re, im = transfer[t] * turns[0, t], transfer[t] * turns[1, t]
        light[0, t], light[1, t] = re, im
        by_omega[0, t], by_omega[1, t] = -densities[t] * im, densities[t] * re
    for m in range(model.orders.size):
        order, ahead, back = np.float32(model.orders[m]), model.forward[m], model.backward[m]
        write_rotors(model.orders[m] * omega, first, turns)
        for t in range(densities.size):
            plus, minus, change = ahead[t] + back[t], ahead[t] - back[t], order * densities[t]
            light[0, t] += plus * turns[0, t]
            light[1, t] += minus * turns[1, t]
            by_omega[0, t] -= change * plus * turns[1, t]
            by_omega[1, t] += change * minus * turns[0, t]


@inner
@uncounted_summing_kernel
def _misfit(model: Model, solution: Floats, room: Room) -> float:
    """Return chi-square of the signal, and write the columns and what the returns leave of it."""
    z, weight, columns, left = room.signal, room.weight, room.columns, room.left
    for k in range(2):
        _write_columns(solution[k], model, columns[k], columns[2 + k], room.turns)
    a, b, total = np.float32(solution[2]), np.float32(solution[3]), np.float32(0.0)
    one, two = columns[2], columns[3]
    for t in range(weight.size):
        re = z[0, t] - a * one[0, t] - b * two[0, t]
        im = z[1, t] - a * one[1, t] - b * two[1, t]
        left[0, t], left[1, t] = re, im
        total += weight[t] * (re * re + im * im)
    return float(total)


@inner
@uncounted_summing_kernel
def _off(solution: Floats, told: Floats, told_sigma: Floats) -> float:
    """Return chi-square of the amplitudes."""
    one, two = (told[0] - solution[2]) / told_sigma[0], (told[1] - solution[3]) / told_sigma[1]
    return float(one * one + two * two)


@inner
@uncounted_summing_kernel
def _write_equations(solution: Floats, told: Floats, told_sigma: Floats, room: Room) -> None:
    """Write the normal matrix, on and below its diagonal, and the right-hand side, after `_misfit`."""
    weight, left, columns, normal, slope = room.weight, room.left, room.columns, room.normal, room.slope
    p, q, r, s = columns[0], columns[1], columns[2], columns[3]
    zero = np.float32(0.0)
    on_p, on_q, on_r, on_s = zero, zero, zero, zero
    pp, qp, rp, sp, qq, rq, sq, rr, sr, ss = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for t in range(weight.size):
        w, x, y = weight[t], left[0, t], left[1, t]
        p_re, p_im, q_re, q_im = w * p[0, t], w * p[1, t], w * q[0, t], w * q[1, t]
        r_re, r_im, s_re, s_im = r[0, t], r[1, t], s[0, t], s[1, t]
        on_p += p_re * x + p_im * y
        pp += p_re * p[0, t] + p_im * p[1, t]
        qp += p_re * q[0, t] + p_im * q[1, t]
        rp += p_re * r_re + p_im * r_im
        sp += p_re * s_re + p_im * s_im
        on_q += q_re * x + q_im * y
        qq += q_re * q[0, t] + q_im * q[1, t]
        rq += q_re * r_re + q_im * r_im
        sq += q_re * s_re + q_im * s_im
        on_r += w * (r_re * x + r_im * y)
        rr += w * (r_re * r_re + r_im * r_im)
        sr += w * (r_re * s_re + r_im * s_im)
        on_s += w * (s_re * x + s_im * y)
        ss += w * (s_re * s_re + s_im * s_im)
    a, b = solution[2], solution[3]
    normal[0, 0], slope[0] = a * a * pp, a * on_p
    normal[1, 0], normal[1, 1], slope[1] = a * b * qp, b * b * qq, b * on_q
    normal[2, 0], normal[2, 1], normal[2, 2] = a * rp, b * rq, float(rr)
    normal[3, 0], normal[3, 1], normal[3, 2], normal[3, 3] = a * sp, b * sq, float(sr), float(ss)
    slope[2], slope[3] = float(on_r), float(on_s)
    for k in range(2):
        precision = 1.0 / (told_sigma[k] * told_sigma[k])
        normal[2 + k, 2 + k] += precision
        slope[2 + k] += precision * (told[k] - solution[2 + k])


@inner
@uncounted_summing_kernel
def _fit(
    model: Model,
    told: Floats,
    told_sigma: Floats,
    enough: float,
    solution: Floats,
    room: Room,
) -> float:
    """Move a solution to the next minimum by damped Gauss-Newton; return chi-square with the amplitudes'.

    It does not move on where all steps together would not bring that below `enough`. The equations from which
    the last, negligible step was taken are left behind; what that step gains is not looked at.
    """
    slope, step, trial = room.slope, room.step, room.trial
    longest = pi / room.weight.size  # half a bin
    lowest = _misfit(model, solution, room) + _off(solution, told, told_sigma)
    _write_equations(solution, told, told_sigma, room)
    damping = _DAMPING
    for _ in range(_STEPS):
        for i in range(4):
            step[i] = slope[i]
        if not factorize(room.normal, 0, 4, damping, room.factor):
            damping *= _HARDER
            continue
        substitute(room.factor, 4, step)
        length = max(abs(step[0]), abs(step[1]))
        part = min(1.0, longest / max(length, longest))
        gain = 0.0
        for i in range(4):
            trial[i] = solution[i] + part * step[i]
            gain += step[i] * slope[i]
        if gain <= _NEGLIGIBLE and length <= _SHORT * longest:
            for i in range(4):
                solution[i] = trial[i]
            return lowest
        reached = _misfit(model, trial, room) + _off(trial, told, told_sigma)
        if not reached <= lowest * _ROUNDING:
            damping *= _HARDER
            continue
        lowest, damping = reached, damping * _EASIER
        for i in range(4):
            solution[i] = trial[i]
        if gain <= max(_NEGLIGIBLE, (lowest - enough) / _STEPS):
            break
        _write_equations(solution, told, told_sigma, room)
    return lowest


@inner
@uncounted_summing_kernel
def _write_sigma(room: Room, sigma: Floats) -> None:
    """Write the standard deviations of both omega from the equations."""
    known = factorize(room.normal, 0, 4, 0.0, room.factor)
    for k in range(2):
        sigma[k] = np.inf
        if known:
            for i in range(4):
                room.step[i] = 1.0 if i == k else 0.0
            substitute(room.factor, 4, room.step)
            sigma[k] = np.sqrt(room.step[k])


@inner
@uncounted_summing_kernel
def _distance(model: Model, told: Floats, room: Room) -> float:
    """Return the distance, of those to start from, at which both amplitudes together fall as z does."""
    z, weight, transfer = room.signal, room.weight, model.transfer
    a, b = np.float32(told[0]), np.float32(told[1])
    alone, both = a * a + b * b, np.float32(2.0) * a * b
    best, least = 0, np.inf
    for i in range(model.apart.size):
        cosines, total = model.cosines[i], np.float32(0.0)
        for t in range(weight.size):
            power = transfer[t] * transfer[t] * (alone + both * cosines[t])
            off = z[0, t] * z[0, t] + z[1, t] * z[1, t] - power
            total += weight[t] * off * off
        if total < least:
            best, least = i, float(total)
    return float(model.apart[best])


@inner
@uncounted_summing_kernel
def _fit_sides(model: Model, known: Known, n: int, solved: Solved, room: Room) -> None:
    """Fit the n-th pixel, whose signal and weight are written, on either side."""
    found, told, told_sigma = known.found[n], known.told[n], known.told_sigma[n]
    solved.without[n] = _misfit(model, found, room)
    middle = (found[0] * found[2] + found[1] * found[3]) / (found[2] + found[3])
    apart = _distance(model, told, room)
    lowest, before = np.inf, told
    for side in range(2):
        solution = solved.solutions[n, side]
        share = before[1] / (before[0] + before[1])
        solution[0], solution[1] = middle - share * apart, middle + (1.0 - share) * apart
        solution[2], solution[3] = before[0], before[1]
        reached = _fit(model, told, told_sigma, lowest + DECIDED, solution, room)
        solved.misfits[n, side] = reached
        if reached < lowest:
            lowest = reached
            _write_sigma(room, solved.sigma[n])
        # The other side is looked for where it shows as much but for the third power of t.
        before = solution[2:]
        middle = (solution[0] * before[0] + solution[1] * before[1]) / (before[0] + before[1])
        apart = solution[0] - solution[1]


@uncounted_summing_kernel
def fit_row(
    signal: Singles,
    lost: NDArray[np.uint8],
    precision: Singles,
    columns: Ints,
    first: int,
    model: Model,
    known: Known,
    solved: Solved,
    room: Room,
) -> None:
    """Fit two returns to some pixels of a row.

    Parameters
    ----------
    signal, lost
        Of the row, as `read_signal` writes them, (2, densities, columns) and (densities + 1, columns).
    precision
        Inverse variance of either part of z, (densities, pixels).
    columns
        Of the pixels, (pixels,).
    first
        The number of the first pixel in `known` and `solved`.
    model, known, solved
        Of the returns; of the pixels; and written.
    room
        Of `new_room`.
    """
    z, weight, block = room.signal, room.weight, room.block
    for start in range(0, columns.size, len(block)):
        count = min(len(block), columns.size - start)
        # Some pixels at a time: one alone lies in as many lines of the processor's cache as it has densities.
        for t in range(weight.size):
            for i in range(count):
                column = columns[start + i]
                block[i, 0, t], block[i, 1, t] = signal[0, t, column], signal[1, t, column]
                block[i, 2, t] = np.float32(0.0) if lost[t, column] else precision[t, start + i]
        for i in range(count):
            for t in range(weight.size):
                z[0, t], z[1, t], weight[t] = block[i, 0, t], block[i, 1, t], block[i, 2, t]
            _fit_sides(model, known, first + start + i, solved, room)
