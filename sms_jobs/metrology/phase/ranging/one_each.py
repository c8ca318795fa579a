"""The fit of one return to each of `LANES` pixels at once.

Most pixels hold one return, and its fit from an interpolated peak needs a step or two. Done for all pixels
of a chunk together it costs a tenth of what it costs pixel by pixel. Whatever does not converge so is left
to the fit of single pixels. Where several rows are written, arrays are handed over flat: only then does the
compiler see that rows do not overlap.

Sums over t are in single precision. Their exp(i omega t) start from double precision every four groups of
densities, so that rounding does not grow with t; omega itself is in double.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import summing_kernel
from sms_jobs.metrology.phase.ranging.fit import UT, UTT, VTT, G, U, V, W
from sms_jobs.metrology.phase.ranging.transform import LANES

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

GROUP = 4  # densities that are summed together

# Parts of the flat state of a return, LANES numbers each. It is flat, and the parts constants, for the
# compiler to see that they do not overlap.
STEP_TIMES_S = 0
OMEGA = LANES
_COSINE = 2 * LANES
_SINE = 3 * LANES
AMPLITUDE = 4 * LANES
SQUARES = 5 * LANES
FALL = 6 * LANES
_C = 7 * LANES
_S = 8 * LANES
SIZE = 9 * LANES

# Parts of the flat single-precision registers of a return.
TURN_C = 0
TURN_S = LANES
SCALE = 2 * LANES
IN_PHASE = 3 * LANES
IN_QUADRATURE = 4 * LANES
_GROUP_C = 5 * LANES
_GROUP_S = 6 * LANES
FAST = 7 * LANES

_STEPS = 3
SMALL = 0.1  # step of omega, times s, after which the cube of it that is left does not matter


@summing_kernel
def _set_turns(first: int, state: Floats, fast: Single) -> None:
    """Set the running exp(i omega t) to the first density, and the turns by one, a group and four groups.

    cos and sin of omega come from their series at omega / 4.
    """
    for j in range(LANES):
        x = 0.25 * state[OMEGA + j]
        q = x * x
        s = 1.0 - q * (1 / 110) * (1.0 - q * (1 / 156) * (1.0 - q * (1 / 210)))
        s = x * (1.0 - q * (1 / 6) * (1.0 - q * (1 / 20) * (1.0 - q * (1 / 42) * (1.0 - q * (1 / 72) * s))))
        c = 1.0 - q * (1 / 90) * (1.0 - q * (1 / 132) * (1.0 - q * (1 / 182) * (1.0 - q * (1 / 240))))
        c = 1.0 - q * 0.5 * (1.0 - q * (1 / 12) * (1.0 - q * (1 / 30) * (1.0 - q * (1 / 56) * c)))
        c, s = c * c - s * s, 2.0 * c * s
        c, s = c * c - s * s, 2.0 * c * s
        state[_C + j] = 1.0 if first == 0 else c
        state[_S + j] = 0.0 if first == 0 else s
        fast[TURN_C + j] = c
        fast[TURN_S + j] = s
        fast[SCALE + j] = state[AMPLITUDE + j]
        fast[IN_PHASE + j] = 0.0
        fast[IN_QUADRATURE + j] = 0.0
        c, s = c * c - s * s, 2.0 * c * s
        c, s = c * c - s * s, 2.0 * c * s
        fast[_GROUP_C + j] = c
        fast[_GROUP_S + j] = s
        c, s = c * c - s * s, 2.0 * c * s
        state[_COSINE + j] = c * c - s * s
        state[_SINE + j] = 2.0 * c * s


@summing_kernel
def _turn(row: int, state: Floats, rotors: Single, fast: Single) -> None:
    """Write exp(i omega t) of four groups, the first in double precision, which is then advanced by four."""
    o = row * LANES
    for j in range(LANES):
        p, q = fast[_GROUP_C + j], fast[_GROUP_S + j]
        a, b = state[_C + j], state[_S + j]
        c, s = np.float32(a), np.float32(b)
        rotors[np.uint64(o + j)] = c
        rotors[np.uint64(o + 1 * LANES + j)] = s
        c, s = c * p - s * q, s * p + c * q
        rotors[np.uint64(o + 4 * LANES + j)] = c
        rotors[np.uint64(o + 5 * LANES + j)] = s
        c, s = c * p - s * q, s * p + c * q
        rotors[np.uint64(o + 8 * LANES + j)] = c
        rotors[np.uint64(o + 9 * LANES + j)] = s
        c, s = c * p - s * q, s * p + c * q
        rotors[np.uint64(o + 12 * LANES + j)] = c
        rotors[np.uint64(o + 13 * LANES + j)] = s
        state[_C + j] = a * state[_COSINE + j] - b * state[_SINE + j]
        state[_S + j] = b * state[_COSINE + j] + a * state[_SINE + j]


@summing_kernel
def set_rotors(first: int, row: int, state: Floats, rotors: Single, fast: Single) -> None:
    """Write exp(i omega t) of every `GROUP`-th density to rows `row` (cos) and the next (sin) of each group.

    Sets up the single-precision registers of the return, too.
    """
    _set_turns(first, state, fast)
    rows = rotors.reshape(-1)
    for t in range(row, rotors.shape[0], 4 * GROUP):
        _turn(t, state, rows, fast)


@summing_kernel
def _advance(x: Single, y: Single, t: int, weights: Single, rotors: Single, fast: Single) -> None:
    """Add a group of densities to Re sum u z exp(-i omega t) and Im sum u t z exp(-i omega t)."""
    u0, u1, u2, u3 = weights[U, t], weights[U, t + 1], weights[U, t + 2], weights[U, t + 3]
    w0, w1, w2, w3 = weights[UT, t], weights[UT, t + 1], weights[UT, t + 2], weights[UT, t + 3]
    for j in range(LANES):
        p, q = fast[TURN_C + j], fast[TURN_S + j]
        c, s = rotors[t, j], rotors[t + 1, j]
        a = u0 * (x[t, j] * c + y[t, j] * s)
        b = w0 * (y[t, j] * c - x[t, j] * s)
        c, s = c * p - s * q, s * p + c * q
        a += u1 * (x[t + 1, j] * c + y[t + 1, j] * s)
        b += w1 * (y[t + 1, j] * c - x[t + 1, j] * s)
        c, s = c * p - s * q, s * p + c * q
        a += u2 * (x[t + 2, j] * c + y[t + 2, j] * s)
        b += w2 * (y[t + 2, j] * c - x[t + 2, j] * s)
        c, s = c * p - s * q, s * p + c * q
        a += u3 * (x[t + 3, j] * c + y[t + 3, j] * s)
        b += w3 * (y[t + 3, j] * c - x[t + 3, j] * s)
        fast[IN_PHASE + j] += a
        fast[IN_QUADRATURE + j] += b


@summing_kernel
def _move(v: float, vtt: float, s: float, state: Floats, fast: Single) -> None:
    """Turn the sums into amplitude and Gauss-Newton step of omega, half a bin at most, and go there."""
    per_v, per_s, lever = 1.0 / v, 1.0 / s, s / vtt
    for j in range(LANES):
        slope = np.float64(fast[IN_QUADRATURE + j])
        a = fast[IN_PHASE + j] * per_v
        step = lever * slope / max(a, 1e-30)
        step = max(min(step, 3.0), -3.0)
        state[STEP_TIMES_S + j] = step
        step *= per_s
        state[AMPLITUDE + j] = a + 0.5 * slope * step * per_v  # at the end of the step
        state[OMEGA + j] += step


@summing_kernel
def _remove(x: Single, y: Single, t: int, weights: Single, rotors: Single, fast: Single) -> None:
    """Take a group of densities of the model out of the signal; add what is left to its sums."""
    g = weights[G, t], weights[G, t + 1], weights[G, t + 2], weights[G, t + 3]
    w = weights[W, t], weights[W, t + 1], weights[W, t + 2], weights[W, t + 3]
    m = weights[UTT, t], weights[UTT, t + 1], weights[UTT, t + 2], weights[UTT, t + 3]
    o = t * LANES
    for j in range(LANES):
        p, q, a = fast[TURN_C + j], fast[TURN_S + j], fast[SCALE + j]
        c, s = rotors[np.uint64(o + j)], rotors[np.uint64(o + 1 * LANES + j)]
        rx, ry = x[np.uint64(o + j)] - g[0] * a * c, y[np.uint64(o + j)] - g[0] * a * s
        x[np.uint64(o + j)] = rx
        y[np.uint64(o + j)] = ry
        left = w[0] * (rx * rx + ry * ry)
        fall = m[0] * (rx * c + ry * s)
        c, s = c * p - s * q, s * p + c * q
        rx, ry = (
            x[np.uint64(o + 1 * LANES + j)] - g[1] * a * c,
            y[np.uint64(o + 1 * LANES + j)] - g[1] * a * s,
        )
        x[np.uint64(o + 1 * LANES + j)] = rx
        y[np.uint64(o + 1 * LANES + j)] = ry
        left += w[1] * (rx * rx + ry * ry)
        fall += m[1] * (rx * c + ry * s)
        c, s = c * p - s * q, s * p + c * q
        rx, ry = (
            x[np.uint64(o + 2 * LANES + j)] - g[2] * a * c,
            y[np.uint64(o + 2 * LANES + j)] - g[2] * a * s,
        )
        x[np.uint64(o + 2 * LANES + j)] = rx
        y[np.uint64(o + 2 * LANES + j)] = ry
        left += w[2] * (rx * rx + ry * ry)
        fall += m[2] * (rx * c + ry * s)
        c, s = c * p - s * q, s * p + c * q
        rx, ry = (
            x[np.uint64(o + 3 * LANES + j)] - g[3] * a * c,
            y[np.uint64(o + 3 * LANES + j)] - g[3] * a * s,
        )
        x[np.uint64(o + 3 * LANES + j)] = rx
        y[np.uint64(o + 3 * LANES + j)] = ry
        left += w[3] * (rx * rx + ry * ry)
        fall += m[3] * (rx * c + ry * s)
        fast[IN_PHASE + j] += left
        fast[IN_QUADRATURE + j] += fall


@summing_kernel
def fit_one_each(
    x: Single,
    y: Single,
    count: int,
    weights: Single,
    sums: Floats,
    first: int,
    state: Floats,
    rotors: Single,
    fast: Single,
) -> None:
    """Fit one return to every pixel of a chunk.

    Parameters
    ----------
    x, y
        z(t), (densities, LANES), 0 beyond `count` up to a multiple of `GROUP`; become what the return leaves.
    weights, sums
        (14, densities or more) of `fit_weights`, for unsaturated pixels, and their sums.
    first
        t of the first density.
    state
        (SIZE,): omega is the start, and becomes the end; the amplitude, the weighted sum of squares,
        Re sum u t^2 r exp(-i omega t) of the residual r, and the last step of omega times s (by the cube of
        which it may be wrong) are written.
    rotors, fast
        Scratch, (densities up to a multiple of four groups, LANES) and (2 FAST,).
    """
    for _ in range(_STEPS):
        set_rotors(first, int(np.int64(0)), state, rotors, fast)
        for t in range(0, x.shape[0], GROUP):
            _advance(x, y, t, weights, rotors, fast)
        _move(sums[V], sums[VTT], count, state, fast)
        largest = 0.0
        for j in range(LANES):
            largest = max(largest, abs(state[STEP_TIMES_S + j]))
        if largest < SMALL:
            break
    set_rotors(first, int(np.int64(0)), state, rotors, fast)
    flat_x, flat_y, flat_rotors = x.reshape(-1), y.reshape(-1), rotors.reshape(-1)
    for t in range(0, x.shape[0], GROUP):
        _remove(flat_x, flat_y, t, weights, flat_rotors, fast)
    for j in range(LANES):
        state[SQUARES + j] = fast[IN_PHASE + j]
        state[FALL + j] = fast[IN_QUADRATURE + j]
