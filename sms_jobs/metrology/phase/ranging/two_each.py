"""The fit of two returns to each of `LANES` pixels at once, by Gauss-Newton on omega and amplitude of both.

With p_i = a_i d omega_i, d = omega_1 - omega_2, and C, T, K = sum v cos dt, sum v t sin dt, sum v t^2 cos dt,
V, Q = sum v, sum v t^2, the normal equations fall apart into sums and differences of the two returns:
[[V - C, T], [T, Q + K]] holds for (a_1 - a_2, p_1 + p_2), [[V + C, -T], [-T, Q - K]] for
(a_1 + a_2, p_1 - p_2). C, T, K depend on d alone and come from a table.
"""

from __future__ import annotations

from math import pi
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import summing_kernel
from sms_jobs.metrology.phase.ranging.fit import UT, UTT, VTT, G, U, V, W
from sms_jobs.metrology.phase.ranging.one_each import (
    AMPLITUDE,
    FALL,
    FAST,
    GROUP,
    IN_PHASE,
    IN_QUADRATURE,
    OMEGA,
    SCALE,
    SIZE,
    SQUARES,
    STEP_TIMES_S,
    TURN_C,
    TURN_S,
    set_rotors,
)
from sms_jobs.metrology.phase.ranging.transform import LANES

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

# Further parts of the state of two returns, behind those of both.
GAIN = 2 * SIZE
VARIANCE = 2 * SIZE + LANES
_OVER = 2 * SIZE + 2 * LANES
_SHIFT = 2 * SIZE + 3 * LANES
_CURVE = 2 * SIZE + 4 * LANES
_BETWEEN = 2 * SIZE + 5 * LANES
PAIR_SIZE = 2 * SIZE + 6 * LANES

_LONGEST = 3.0  # step x s: half a bin
_BOLDEST = 0.4  # step over the distance of both returns, beyond which the linear model says little
_DONE = 0.01  # step x s after which no further one is needed: what is left is its square
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


@summing_kernel
def _advance(x: Single, y: Single, t: int, weights: Single, rotors: Single, fast: Single) -> None:
    """Add a group of densities of the residual to the sums of both returns, in phase and in quadrature."""
    g = weights[G, t], weights[G, t + 1], weights[G, t + 2], weights[G, t + 3]
    u = weights[U, t], weights[U, t + 1], weights[U, t + 2], weights[U, t + 3]
    w = weights[UT, t], weights[UT, t + 1], weights[UT, t + 2], weights[UT, t + 3]
    for j in range(LANES):
        p, q, a = fast[TURN_C + j], fast[TURN_S + j], fast[SCALE + j]
        m, n, b = fast[FAST + TURN_C + j], fast[FAST + TURN_S + j], fast[FAST + SCALE + j]
        c, s = rotors[t, j], rotors[t + 1, j]
        d, e = rotors[t + 2, j], rotors[t + 3, j]
        rx, ry = x[t, j] - g[0] * (a * c + b * d), y[t, j] - g[0] * (a * s + b * e)
        h, k = u[0] * (rx * c + ry * s), w[0] * (ry * c - rx * s)
        h2, k2 = u[0] * (rx * d + ry * e), w[0] * (ry * d - rx * e)
        c, s, d, e = c * p - s * q, s * p + c * q, d * m - e * n, e * m + d * n
        rx, ry = x[t + 1, j] - g[1] * (a * c + b * d), y[t + 1, j] - g[1] * (a * s + b * e)
        h, k = h + u[1] * (rx * c + ry * s), k + w[1] * (ry * c - rx * s)
        h2, k2 = h2 + u[1] * (rx * d + ry * e), k2 + w[1] * (ry * d - rx * e)
        c, s, d, e = c * p - s * q, s * p + c * q, d * m - e * n, e * m + d * n
        rx, ry = x[t + 2, j] - g[2] * (a * c + b * d), y[t + 2, j] - g[2] * (a * s + b * e)
        h, k = h + u[2] * (rx * c + ry * s), k + w[2] * (ry * c - rx * s)
        h2, k2 = h2 + u[2] * (rx * d + ry * e), k2 + w[2] * (ry * d - rx * e)
        c, s, d, e = c * p - s * q, s * p + c * q, d * m - e * n, e * m + d * n
        rx, ry = x[t + 3, j] - g[3] * (a * c + b * d), y[t + 3, j] - g[3] * (a * s + b * e)
        h, k = h + u[3] * (rx * c + ry * s), k + w[3] * (ry * c - rx * s)
        h2, k2 = h2 + u[3] * (rx * d + ry * e), k2 + w[3] * (ry * d - rx * e)
        fast[IN_PHASE + j] += h
        fast[IN_QUADRATURE + j] += k
        fast[FAST + IN_PHASE + j] += h2
        fast[FAST + IN_QUADRATURE + j] += k2


@summing_kernel
def _look_up(overlaps: Floats, state: Floats) -> None:
    """Interpolate C, T and K in the table, linearly but for their known curvature."""
    last = np.uint32(overlaps.shape[0] - 2)
    per_entry = last / pi
    entry = 1.0 / per_entry
    for j in range(LANES):
        d = state[OMEGA + j] - state[SIZE + OMEGA + j]
        d -= 2.0 * pi * np.rint(d * (0.5 / pi))
        state[_BETWEEN + j] = d
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
        state[_OVER + j] = over + bow * entry * curve
        state[_SHIFT + j] = shift if d > 0.0 else -shift
        fourth = overlaps[k, 3] + part * (overlaps[after, 3] - overlaps[k, 3])
        state[_CURVE + j] = curve + bow * entry * fourth


@summing_kernel
def _move(v: float, vtt: float, s: float, state: Floats, fast: Single) -> None:
    """Solve the normal equations for a step of both returns, omega by half a bin at most, and go there."""
    per_s = 1.0 / s
    for j in range(LANES):
        over, shift, curve = state[_OVER + j], state[_SHIFT + j], state[_CURVE + j]
        h1, q1 = np.float64(fast[IN_PHASE + j]), np.float64(fast[IN_QUADRATURE + j])
        h2, q2 = np.float64(fast[FAST + IN_PHASE + j]), np.float64(fast[FAST + IN_QUADRATURE + j])
        even = 0.5 / max((v - over) * (vtt + curve) - shift * shift, 1e-6 * v * vtt)
        odd = 0.5 / max((v + over) * (vtt - curve) - shift * shift, 1e-6 * v * vtt)
        along = ((v - over) * (q1 + q2) - shift * (h1 - h2)) * even
        apart = ((v + over) * (q1 - q2) + shift * (h1 + h2)) * odd
        less = ((vtt + curve) * (h1 - h2) - shift * (q1 + q2)) * even
        more = ((vtt - curve) * (h1 + h2) + shift * (q1 - q2)) * odd
        state[GAIN + j] = (
            (more + less) * h1 + (more - less) * h2 + (along + apart) * q1 + (along - apart) * q2
        )
        a, b = max(state[AMPLITUDE + j], 1e-30), max(state[SIZE + AMPLITUDE + j], 1e-30)
        one, two = s * (along + apart) / a, s * (along - apart) / b
        largest = max(abs(one), abs(two))
        state[STEP_TIMES_S + j] = largest
        part = min(1.0, min(_LONGEST, _BOLDEST * s * abs(state[_BETWEEN + j])) / max(largest, 1e-30))
        one, two, along, apart = part * one, part * two, part * along, part * apart
        # The amplitudes that are best where omega goes to.
        less = 0.5 * (h1 - h2 - 2.0 * shift * along) / max(v - over, 1e-6 * v)
        more = 0.5 * (h1 + h2 + 2.0 * shift * apart) / max(v + over, 1e-6 * v)
        state[OMEGA + j] += one * per_s
        state[SIZE + OMEGA + j] += two * per_s
        state[AMPLITUDE + j] += more + less
        state[SIZE + AMPLITUDE + j] += more - less


@summing_kernel
def _vary(v: float, vtt: float, state: Floats) -> None:
    """Write the variance of a_i omega_i for unit noise where the fit ends."""
    for j in range(LANES):
        over, shift, curve = state[_OVER + j], state[_SHIFT + j], state[_CURVE + j]
        even = 0.5 / max((v - over) * (vtt + curve) - shift * shift, 1e-6 * v * vtt)
        odd = 0.5 / max((v + over) * (vtt - curve) - shift * shift, 1e-6 * v * vtt)
        state[VARIANCE + j] = (v - over) * even + (v + over) * odd


@summing_kernel
def _remove(x: Single, y: Single, t: int, weights: Single, rotors: Single, fast: Single) -> None:
    """Take a group of densities of the model out of the signal; add what is left to its sums."""
    g = weights[G, t], weights[G, t + 1], weights[G, t + 2], weights[G, t + 3]
    w = weights[W, t], weights[W, t + 1], weights[W, t + 2], weights[W, t + 3]
    u = weights[UTT, t], weights[UTT, t + 1], weights[UTT, t + 2], weights[UTT, t + 3]
    o = t * LANES
    for j in range(LANES):
        p, q, a = fast[TURN_C + j], fast[TURN_S + j], fast[SCALE + j]
        m, n, b = fast[FAST + TURN_C + j], fast[FAST + TURN_S + j], fast[FAST + SCALE + j]
        c, s = rotors[np.uint64(o + j)], rotors[np.uint64(o + 1 * LANES + j)]
        d, e = rotors[np.uint64(o + 2 * LANES + j)], rotors[np.uint64(o + 3 * LANES + j)]
        rx, ry = x[np.uint64(o + j)] - g[0] * (a * c + b * d), y[np.uint64(o + j)] - g[0] * (a * s + b * e)
        x[np.uint64(o + j)], y[np.uint64(o + j)] = rx, ry
        left = w[0] * (rx * rx + ry * ry)
        fall = u[0] * (rx * c + ry * s)
        fell = u[0] * (rx * d + ry * e)
        c, s, d, e = c * p - s * q, s * p + c * q, d * m - e * n, e * m + d * n
        rx, ry = (
            x[np.uint64(o + 1 * LANES + j)] - g[1] * (a * c + b * d),
            y[np.uint64(o + 1 * LANES + j)] - g[1] * (a * s + b * e),
        )
        x[np.uint64(o + 1 * LANES + j)], y[np.uint64(o + 1 * LANES + j)] = rx, ry
        left += w[1] * (rx * rx + ry * ry)
        fall += u[1] * (rx * c + ry * s)
        fell += u[1] * (rx * d + ry * e)
        c, s, d, e = c * p - s * q, s * p + c * q, d * m - e * n, e * m + d * n
        rx, ry = (
            x[np.uint64(o + 2 * LANES + j)] - g[2] * (a * c + b * d),
            y[np.uint64(o + 2 * LANES + j)] - g[2] * (a * s + b * e),
        )
        x[np.uint64(o + 2 * LANES + j)], y[np.uint64(o + 2 * LANES + j)] = rx, ry
        left += w[2] * (rx * rx + ry * ry)
        fall += u[2] * (rx * c + ry * s)
        fell += u[2] * (rx * d + ry * e)
        c, s, d, e = c * p - s * q, s * p + c * q, d * m - e * n, e * m + d * n
        rx, ry = (
            x[np.uint64(o + 3 * LANES + j)] - g[3] * (a * c + b * d),
            y[np.uint64(o + 3 * LANES + j)] - g[3] * (a * s + b * e),
        )
        x[np.uint64(o + 3 * LANES + j)], y[np.uint64(o + 3 * LANES + j)] = rx, ry
        left += w[3] * (rx * rx + ry * ry)
        fall += u[3] * (rx * c + ry * s)
        fell += u[3] * (rx * d + ry * e)
        fast[IN_QUADRATURE + j] += left
        fast[IN_PHASE + j] += fall
        fast[FAST + IN_PHASE + j] += fell


@summing_kernel
def is_done(step_times_s: float, gain: float, variance: float) -> bool:
    """Tell whether a step was the last one that a pixel needs."""
    return bool(step_times_s < _DONE or gain < _NEGLIGIBLE * variance)


@summing_kernel
def fit_two_each(
    x: Single,
    y: Single,
    count: int,
    weights: Single,
    sums: Floats,
    overlaps: Floats,
    first: int,
    wanted: NDArray[np.bool_],
    variance: Floats,
    steps: int,
    state: Floats,
    rotors: Single,
    fast: Single,
) -> None:
    """Fit two returns to every pixel of a chunk, until those `wanted` do not move.

    Parameters
    ----------
    overlaps
        Of `overlap_table`.
    wanted, variance
        (LANES,): which pixels matter, and the variance of their z.
    steps
        Most steps.
    state
        (PAIR_SIZE,): omega and amplitude of both returns are the start, and become the end; written are for
        both what `fit_one_each` writes, but the larger step and the sum of squares for the first alone; the
        last step's gain in chi-square, and the variance of a_i omega_i for unit noise.

    The other parameters are those of `fit_one_each`.
    """
    second, fast_second = state[SIZE:], fast[FAST:]
    for _ in range(steps):
        set_rotors(first, int(np.int64(0)), state, rotors, fast)
        set_rotors(first, int(np.int64(2)), second, rotors, fast_second)
        for t in range(0, x.shape[0], GROUP):
            _advance(x, y, t, weights, rotors, fast)
        _look_up(overlaps, state)
        _move(sums[V], sums[VTT], count, state, fast)
        moving = 0
        for j in range(LANES):
            if wanted[j] and not is_done(state[STEP_TIMES_S + j], state[GAIN + j], variance[j]):
                moving += 1
        if moving == 0:
            break
    _look_up(overlaps, state)
    _vary(sums[V], sums[VTT], state)
    set_rotors(first, int(np.int64(0)), state, rotors, fast)
    set_rotors(first, int(np.int64(2)), second, rotors, fast_second)
    flat_x, flat_y, flat_rotors = x.reshape(-1), y.reshape(-1), rotors.reshape(-1)
    for t in range(0, x.shape[0], GROUP):
        _remove(flat_x, flat_y, t, weights, flat_rotors, fast)
    for j in range(LANES):
        state[SQUARES + j] = fast[IN_QUADRATURE + j]
        state[FALL + j] = fast[IN_PHASE + j]
        state[SIZE + FALL + j] = fast[FAST + IN_PHASE + j]
