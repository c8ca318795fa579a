"""Where the fit of two close returns starts, for `LANES` pixels at once.

Two returns within half a bin are one peak, and what one return leaves of them peaks at neither. But Re H
near the peak tells what any two returns there would explain: with h_i = Re H(omega_i), C = sum v cos dt and
V = sum v, that is [(h_1 + h_2)^2 / (V + C) + (h_1 - h_2)^2 / (V - C)] / 2. They start where it is greatest on
a grid.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import inner, kernel, summing_kernel
from sms_jobs.metrology.phase.ranging.batched_sums import (
    AMPLITUDE,
    COSINE,
    GROUP_COSINE,
    GROUP_SINE,
    OMEGA,
    SINE,
    SIZE,
    Room,
    half_turn,
    turn_by_group,
)
from sms_jobs.metrology.phase.ranging.transform import LANES, Peaks

_NODES = 11
_APART = 0.3  # bins between nodes: they reach 1.5 bins to either side


_RUN = 8  # densities that are turned from one to the next in single precision; longer loops are not unrolled

# Parts of registers: what turns exp(i omega t) by one.
_TURN_COSINE = 0
_TURN_SINE = LANES


class Grid(NamedTuple):
    """Places near a peak: their distance from it in rad, (nodes,), cos and sin of that times t, and pairs.

    `turns` is (2, nodes, densities); `shares` (2, nodes) are 1 / (V + C) and 1 / (V - C) of two places that
    are as many nodes apart, the first of the latter 0; infinite where both are one.
    """

    places: Floats
    turns: Singles
    shares: Singles


def grid(densities: Floats, v: Floats, padded: int) -> Grid:
    """Return the grid of a sequence from v of every density."""
    places = (np.arange(_NODES) - _NODES // 2) * _APART * 2.0 * pi / densities.size
    turns = np.zeros((2, _NODES, padded), np.float32)
    angles = np.outer(places, densities)
    turns[:, :, : densities.size] = np.cos(angles), np.sin(angles)
    over = np.cos(np.outer(places - places[0], densities)) @ v
    shares = np.zeros((2, _NODES), np.float32)
    shares[0] = 1.0 / (over[0] + over)
    gap = over[0] - over[1:]  # nothing where two places are a whole turn apart, and are one
    shares[1, 1:] = np.divide(1.0, gap, out=np.full(gap.size, np.inf), where=gap > 1e-9 * over[0])
    return Grid(places, turns, shares)


@inner
@summing_kernel
def _start_rotors(first: int, estimate: Floats, registers: Singles) -> None:
    """Set exp(i omega t) to the first density, and what turns it by one and by `_RUN` densities."""
    for j in range(LANES):
        c, s = half_turn(0.5 * estimate[OMEGA + j])
        c, s = c * c - s * s, 2.0 * c * s
        estimate[COSINE + j] = 1.0 if first == 0 else c
        estimate[SINE + j] = 0.0 if first == 0 else s
        registers[_TURN_COSINE + j] = c
        registers[_TURN_SINE + j] = s
        for _ in range(3):
            c, s = c * c - s * s, 2.0 * c * s
        estimate[GROUP_COSINE + j] = c
        estimate[GROUP_SINE + j] = s


@inner
@summing_kernel
def _turn_back(
    x: Singles, y: Singles, u: Singles, estimate: Floats, registers: Singles, re: Singles, im: Singles
) -> None:
    """Write u z exp(-i omega t); all but `u` and the last three are flat."""
    for t in range(0, x.size // LANES, _RUN):
        for j in range(LANES):
            c, s = np.float32(estimate[COSINE + j]), np.float32(estimate[SINE + j])
            p, q = registers[_TURN_COSINE + j], registers[_TURN_SINE + j]
            for k in range(_RUN):
                i = np.uint64((t + k) * LANES + j)
                re[i] = u[t + k] * (x[i] * c + y[i] * s)
                im[i] = u[t + k] * (y[i] * c - x[i] * s)
                c, s = c * p - s * q, s * p + c * q
        turn_by_group(estimate)


@inner
@summing_kernel
def _sum_turned(part: Singles, rows: int, turns: Singles, out: Singles) -> None:
    """Write the sum over the rows of a flat part, each times its turn."""
    for j in range(LANES):
        out[j] = 0.0
    for t in range(0, rows, _RUN):
        for j in range(LANES):
            total = np.float32(0.0)
            for k in range(_RUN):
                total += turns[t + k] * part[np.uint64((t + k) * LANES + j)]
            out[j] += total


@inner
@summing_kernel
def _keep_better(
    values: Singles, i: int, k: int, even: float, odd: float, best: Singles, which: NDArray[np.int32]
) -> None:
    """Keep the pair of places i, k where its returns, both of positive amplitude, explain more."""
    p, q, code = np.float32(even), np.float32(odd), np.int32(i * _NODES + k)
    for j in range(LANES):
        total, change = values[i, j] + values[k, j], values[i, j] - values[k, j]
        more, less = total * p, change * q
        explained = total * more + change * less
        better = (more > abs(less)) & (explained > best[j])
        best[j] = explained if better else best[j]
        which[j] = code if better else which[j]


@inner
@kernel
def start_close(
    x: Singles,
    y: Singles,
    first: int,
    u: Singles,
    grid: Grid,
    close: Mask,
    single: Floats,
    pair: Floats,
    room: Room,
    scratch: Peaks,
) -> None:
    """Start the `pair` of pixels that are `close` at the two places near their `single` that explain most.

    `pair` and `single` are those of `fit_two` and `fit_one`, as are the other parameters.
    """
    re, im, registers = room.left_x, room.left_y, room.registers
    best, which = scratch.highest, scratch.place
    rows, middle = x.shape[0], _NODES // 2
    _start_rotors(first, single, registers)
    _turn_back(x.reshape(-1), y.reshape(-1), u, single, registers, re, im)
    values = np.empty((_NODES + 1, LANES), np.float32)
    for k in range(middle + 1):
        _sum_turned(re, rows, grid.turns[0, middle + k], values[middle + k])
        _sum_turned(im, rows, grid.turns[1, middle + k], values[_NODES])
        for j in range(LANES):
            even, odd = values[middle + k, j], values[_NODES, j]
            values[middle + k, j] = even + odd
            values[middle - k, j] = even - odd
    best[:] = 0.0
    which[:] = middle * _NODES + middle + 1
    for i in range(_NODES):
        for k in range(i + 1, _NODES):
            _keep_better(values, i, k, grid.shares[0, k - i], grid.shares[1, k - i], best, which)
    for j in range(LANES):
        if not close[j]:
            continue
        i, k = which[j] // _NODES, which[j] % _NODES
        more = (values[i, j] + values[k, j]) * grid.shares[0, k - i]
        less = (values[i, j] - values[k, j]) * grid.shares[1, k - i]
        pair[OMEGA + j] = single[OMEGA + j] + grid.places[i]
        pair[SIZE + OMEGA + j] = single[OMEGA + j] + grid.places[k]
        pair[AMPLITUDE + j] = 0.5 * (more + less)
        pair[SIZE + AMPLITUDE + j] = 0.5 * (more - less)
