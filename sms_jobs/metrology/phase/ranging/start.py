"""Where the fit of two close returns starts, for `LANES` pixels at once.

Two returns within half a bin are one peak, and what one return leaves of them peaks at neither. But Re H
near the peak tells what any two returns there would explain: with h_i = Re H(omega_i), C = sum v cos dt and
V = sum v, that is [(h_1 + h_2)^2 / (V + C) + (h_1 - h_2)^2 / (V - C)] / 2. They start where it is greatest on
a grid.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel, summing_kernel
from sms_jobs.metrology.phase.ranging.fit import U
from sms_jobs.metrology.phase.ranging.one_each import (
    AMPLITUDE,
    GROUP,
    OMEGA,
    SIZE,
    TURN_C,
    TURN_S,
    set_rotors,
)
from sms_jobs.metrology.phase.ranging.transform import LANES

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

_NODES = 11
_APART = 0.3  # bins between nodes: they reach 1.5 bins to either side


class Grid(NamedTuple):
    """Places near a peak: their distance from it in rad, (nodes,), cos and sin of that times t, and pairs.

    `turns` is (2, nodes, densities); `shares` (2, nodes) are 1 / (V + C) and 1 / (V - C) of two places that
    are as many nodes apart, the first of the latter 0.
    """

    places: Floats
    turns: Single
    shares: Single


def grid(densities: Floats, v: Floats, padded: int) -> Grid:
    """Return the grid of a sequence from v of every density."""
    places = (np.arange(_NODES) - _NODES // 2) * _APART * 2.0 * pi / densities.size
    turns = np.zeros((2, _NODES, padded), np.float32)
    angles = np.outer(places, densities)
    turns[:, :, : densities.size] = np.cos(angles), np.sin(angles)
    over = np.cos(np.outer(places - places[0], densities)) @ v
    shares = np.zeros((2, _NODES), np.float32)
    shares[0] = 1.0 / (over[0] + over)
    shares[1, 1:] = 1.0 / (over[0] - over[1:])
    return Grid(places, turns, shares)


@summing_kernel
def _turn_back(
    x: Single, y: Single, t: int, weights: Single, rotors: Single, fast: Single, re: Single, im: Single
) -> None:
    """Write u z exp(-i omega t) of a group of densities."""
    for k in range(GROUP):
        w = weights[U, t + k]
        for j in range(LANES):
            c, s = rotors[t, j], rotors[t + 1, j]
            re[t + k, j] = w * (x[t + k, j] * c + y[t + k, j] * s)
            im[t + k, j] = w * (y[t + k, j] * c - x[t + k, j] * s)
            rotors[t, j] = c * fast[TURN_C + j] - s * fast[TURN_S + j]
            rotors[t + 1, j] = s * fast[TURN_C + j] + c * fast[TURN_S + j]


@summing_kernel
def _add_up(re: Single, rows: int, turns: Single, p: int, k: int, out: Single, i: int) -> None:
    """Write the sum of re times row k of a part of the turns to row i."""
    for j in range(LANES):
        out[i, j] = 0.0
    for t in range(0, rows, GROUP):
        a, b, c, d = turns[p, k, t], turns[p, k, t + 1], turns[p, k, t + 2], turns[p, k, t + 3]
        for j in range(LANES):
            out[i, j] += a * re[t, j] + b * re[t + 1, j] + c * re[t + 2, j] + d * re[t + 3, j]


@summing_kernel
def _compare(
    values: Single, i: int, k: int, even: float, odd: float, best: Single, which: NDArray[np.int32]
) -> None:
    """Keep the pair of places i, k where its returns, both of positive amplitude, explain more."""
    p, q, code = np.float32(even), np.float32(odd), np.int32(i * _NODES + k)
    for j in range(LANES):
        both, less = values[i, j] + values[k, j], values[i, j] - values[k, j]
        more, change = both * p, less * q
        explained = both * more + less * change
        better = (more > abs(change)) & (explained > best[j])
        best[j] = explained if better else best[j]
        which[j] = code if better else which[j]


@kernel
def start_close(
    x: Single,
    y: Single,
    weights: Single,
    first: int,
    grid: Grid,
    one: Floats,
    near: NDArray[np.bool_],
    pair: Floats,
    rotors: Single,
    fast: Single,
    spectrum: Single,
    best: Single,
    which: NDArray[np.int32],
) -> None:
    """Write to the `pair` of pixels that are `near` the two places by their return `one` that explain most.

    `pair` and `one` are those of `fit_two_each` and `fit_one_each`, as are the other parameters; `spectrum`,
    `best` and `which` are scratch.
    """
    re, im = spectrum[0], spectrum[1]
    rows, middle = x.shape[0], _NODES // 2
    set_rotors(first, int(np.int64(0)), one, rotors, fast)
    for t in range(0, rows, GROUP):
        _turn_back(x, y, t, weights, rotors, fast, re, im)
    values = np.empty((_NODES + 1, LANES), np.float32)
    for k in range(middle + 1):
        _add_up(re, rows, grid.turns, int(np.int64(0)), middle + k, values, middle + k)
        _add_up(im, rows, grid.turns, int(np.int64(1)), middle + k, values, _NODES)
        for j in range(LANES):
            even, odd = values[middle + k, j], values[_NODES, j]
            values[middle + k, j] = even + odd
            values[middle - k, j] = even - odd
    best[:] = 0.0
    which[:] = middle * _NODES + middle + 1
    for i in range(_NODES):
        for k in range(i + 1, _NODES):
            _compare(values, i, k, grid.shares[0, k - i], grid.shares[1, k - i], best, which)
    for j in range(LANES):
        if not near[j]:
            continue
        i, k = which[j] // _NODES, which[j] % _NODES
        both, less = values[i, j] + values[k, j], values[i, j] - values[k, j]
        more, change = both * grid.shares[0, k - i], less * grid.shares[1, k - i]
        pair[OMEGA + j] = one[OMEGA + j] + grid.places[i]
        pair[SIZE + OMEGA + j] = one[OMEGA + j] + grid.places[k]
        pair[AMPLITUDE + j] = 0.5 * (more + change)
        pair[SIZE + AMPLITUDE + j] = 0.5 * (more - change)
