"""The least-squares fit of returns to the signal of one pixel.

The model is z(t) = g(t) sum_i a_i exp(i omega_i t) with real a_i > 0, since every return's phase is zero at
t = 0 (known origin), and g the modulation transfer. The amplitudes are linear and are solved for at every
omega (variable projection); omega moves by Gauss-Newton on what remains, damped where that does not help.
Sums over t are in single precision, of products that do not cancel; small systems are in double.
"""

from __future__ import annotations

from math import cos, sin
from typing import TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import summing_kernel

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

inlined = numba.njit(inline="always")
"""Put a function into the code of the kernels that call it: every array that a call hands over is counted in
and out by atomic instructions, which would cost more than these short sums."""

# Rows of the weights over t that `fit_weights` makes.
G, W, U, UT, UTT, V, VT, VTT, VT4, SEARCH, N, NT, NTT, P = range(14)
# Rows of a state: omega, its cos and sin, amplitude, variance of omega per unit noise, variance inside.
OMEGA, COS, SIN, AMPLITUDE, VARIANCE, SPREAD = range(6)

# Parts of a system: see `evaluate`.
_NORMAL, _SHIFT, _FOLLOW, _OMEGA, _SPARE, ROWS = range(6)

_ITERATIONS = 14
_LONGEST = 3.0  # step x s: half a bin
_RETREATS = 6
_ONE_DONE = 0.03  # step x s of one return after which no further one is needed: what is left is its cube
_DONE = 0.01  # the same for several returns, where it is the square
_NEGLIGIBLE = 1e-2  # gain in chi-square that is not worth another step


def fit_weights(
    densities: Floats, precision: Floats, transfer: Floats, window: Floats, padded: int, *, windowed_fit: bool
) -> Single:
    """Return the weights over t of a fit, (14, padded), 0 beyond the densities.

    Rows: g; w; u = w g; u t; u t^2; v = w g^2; v t; v t^2; v t^4; the weights of the search, precision g
    window; the variance n of a windowed sum, precision (g window)^2; n t; n t^2; the precision. w is the
    precision, times the window where the fit is windowed too.
    """
    t, g = densities, transfer
    w = precision * window if windowed_fit else precision
    u, v, n = w * g, w * g * g, precision * (g * window) ** 2
    rows = np.zeros((14, padded), np.float32)
    rows[:, : t.size] = [
        *(g, w, u, u * t, u * t * t, v, v * t, v * t * t, v * t**4),
        *(precision * g * window, n, n * t, n * t * t, precision),
    ]
    return rows


@inlined
def turn(states: Floats, p: int, i: int, step: float) -> None:
    """Add a step to omega of return i of state p, and turn its cosine and sine by it."""
    if abs(step) > 0.125:
        dc, ds = cos(step), sin(step)
    else:
        q = step * step
        ds = step * (1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0)))
        dc = 1.0 - q / 2.0 * (1.0 - q / 12.0 * (1.0 - q / 30.0))
    c, s = states[p, COS, i], states[p, SIN, i]
    states[p, OMEGA, i] += step
    states[p, COS, i] = c * dc - s * ds
    states[p, SIN, i] = s * dc + c * ds


@inlined
def rotors(states: Floats, p: int, i: int, first: int, tables: Single, k: int) -> None:
    """Write cos and sin of omega t, t = first, first + 1, ..., of return i of state p to table k.

    By doubling: what is there, turned by its length, is what comes next.
    """
    c, s = states[p, COS, i], states[p, SIN, i]
    a, b = (1.0, 0.0) if first == 0 else (c, s)
    size = tables.shape[2]
    tables[k, 0, 0], tables[k, 1, 0] = a, b
    tables[k, 0, 1], tables[k, 1, 1] = a * c - b * s, b * c + a * s
    half = 2
    while half < size:
        c, s = c * c - s * s, 2.0 * c * s
        u, v = np.float32(c), np.float32(s)
        for t in range(min(half, size - half)):
            x, y = tables[k, 0, t], tables[k, 1, t]
            tables[k, 0, half + t] = u * x - v * y
            tables[k, 1, half + t] = v * x + u * y
        half *= 2


@inlined
def in_phase(z: Single, j: int, weights: Single, m: int, row: int, tables: Single, k: int) -> np.float32:
    """Return Re sum w z exp(-i omega t) of pixel j of z with a row of weights and table k."""
    h = np.float32(0.0)
    for t in range(z.shape[2]):
        h += weights[m, row, t] * (z[j, 0, t] * tables[k, 0, t] + z[j, 1, t] * tables[k, 1, t])
    return h


@inlined
def in_quadrature(z: Single, j: int, weights: Single, m: int, row: int, tables: Single, k: int) -> np.float32:
    """Return Im sum w z exp(-i omega t), likewise."""
    h = np.float32(0.0)
    for t in range(z.shape[2]):
        h += weights[m, row, t] * (z[j, 1, t] * tables[k, 0, t] - z[j, 0, t] * tables[k, 1, t])
    return h


@inlined
def _overlap(
    tables: Single, i: int, k: int, weights: Single, m: int
) -> tuple[np.float32, np.float32, np.float32]:
    """Return sum v cos(d t), sum v t sin(d t), sum v t^2 cos(d t) for d = omega_i - omega_k."""
    a, b, c = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for t in range(tables.shape[2]):
        p = tables[i, 0, t] * tables[k, 0, t] + tables[i, 1, t] * tables[k, 1, t]
        q = tables[i, 1, t] * tables[k, 0, t] - tables[i, 0, t] * tables[k, 1, t]
        a += weights[m, V, t] * p
        b += weights[m, VT, t] * q
        c += weights[m, VTT, t] * p
    return a, b, c


@inlined
def subtract(amplitude: float, weights: Single, m: int, tables: Single, k: int, z: Single, j: int) -> None:
    """Take one return out of pixel j of a signal, which stays 0 where a density is left out."""
    a = np.float32(amplitude)
    for t in range(z.shape[2]):
        z[j, 0, t] -= a * weights[m, G, t] * tables[k, 0, t]
    for t in range(z.shape[2]):
        z[j, 1, t] -= a * weights[m, G, t] * tables[k, 1, t]


@inlined
def power(z: Single, j: int, weights: Single, m: int, row: int) -> np.float32:
    """Return sum w |z|^2 of pixel j."""
    h = np.float32(0.0)
    for t in range(z.shape[2]):
        h += weights[m, row, t] * (z[j, 0, t] * z[j, 0, t] + z[j, 1, t] * z[j, 1, t])
    return h


@inlined
def factor(system: Floats, f: int, n: int) -> bool:
    """Replace the lower triangle of symmetric matrix f by its Cholesky factor; False if not positive."""
    for i in range(n):
        for j in range(i + 1):
            total = system[f, i, j]
            for k in range(j):
                total -= system[f, i, k] * system[f, j, k]
            if i == j:
                if not total > 1e-12 * system[f, i, i]:
                    return False
                system[f, i, i] = np.sqrt(total)
            else:
                system[f, i, j] = total / system[f, j, j]
    return True


@inlined
def solve(system: Floats, f: int, n: int, r: int) -> None:
    """Replace row r, n long, of the part for rows by the solution, matrix f being of `factor`."""
    for i in range(n):
        for k in range(i):
            system[ROWS, r, i] -= system[f, i, k] * system[ROWS, r, k]
        system[ROWS, r, i] /= system[f, i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            system[ROWS, r, i] -= system[f, k, i] * system[ROWS, r, k]
        system[ROWS, r, i] /= system[f, i, i]


@inlined
def evaluate(
    n: int,
    z: Single,
    j: int,
    weights: Single,
    sums: Floats,
    m: int,
    first: int,
    states: Floats,
    tables: Single,
    left: Single,
    system: Floats,
) -> float:
    """Solve for the amplitudes of n returns at their omega, and set up the step of omega.

    Parameters
    ----------
    z, j
        (pixels, 2, densities), real and imaginary part, and which pixel.
    weights, sums, m
        (2, 14, densities) of `fit_weights`, their sums over the densities, and which of the two holds.
    states
        (3, 6, returns): that at hand, whose amplitudes are written, and two more for `refine` and others.
    tables
        (returns, 2, densities), becomes cos and sin of omega t.
    left
        (pixels, 2, densities); that of pixel j becomes what the model leaves.
    system
        (6, max(returns, 6), returns + 1) becomes the normal matrix of the amplitudes, factored; S and D^T,
        where D = C^-1 S says how amplitudes follow omega; the matrix of omega with its gradient in column n.

    Returns
    -------
    The weighted sum of squares, infinite where two returns are one.

    Notes
    -----
    With C = [sum v cos(d_ij t)], S_ij = sum v t sin((omega_j - omega_i) t), K = [sum v t^2 cos(d_ij t)]:
    C a = h, h_i = Re sum u z exp(-i omega_i t); the projected matrix is A (K - S^T C^-1 S) A, A = diag(a).
    """
    for i in range(n):
        rotors(states, 0, i, first, tables, i)
        system[ROWS, 0, i] = in_phase(z, j, weights, m, U, tables, i)
        system[_NORMAL, i, i] = sums[m, V]
        system[_OMEGA, i, i] = sums[m, VTT]
        system[_SHIFT, i, i] = 0.0
        for k in range(i):
            over, shift, curve = _overlap(tables, i, k, weights, m)
            system[_NORMAL, i, k] = over
            system[_OMEGA, i, k], system[_OMEGA, k, i] = curve, curve
            system[_SHIFT, k, i], system[_SHIFT, i, k] = shift, -shift
    regular = factor(system, _NORMAL, n)
    solve(system, _NORMAL, n, 0)
    for i in range(n):
        states[0, AMPLITUDE, i] = system[ROWS, 0, i]
    for t in range(z.shape[2]):
        left[j, 0, t] = z[j, 0, t]
        left[j, 1, t] = z[j, 1, t]
    for i in range(n):
        subtract(states[0, AMPLITUDE, i], weights, m, tables, i, left, j)
    if n > 1:
        _project(n, system)
    for i in range(n):
        slope = in_quadrature(left, j, weights, m, UT, tables, i)
        system[_OMEGA, i, n] = states[0, AMPLITUDE, i] * slope
        for k in range(n):
            system[_OMEGA, i, k] *= states[0, AMPLITUDE, i] * states[0, AMPLITUDE, k]
    squares = float(power(left, j, weights, m, W))
    return squares if regular else np.inf


@inlined
def _project(n: int, system: Floats) -> None:
    """Write D^T = (C^-1 S)^T and replace K by K - S^T D."""
    for i in range(n):
        for k in range(n):
            system[ROWS, 0, k] = system[_SHIFT, k, i]
        solve(system, _NORMAL, n, 0)
        for k in range(n):
            system[_FOLLOW, i, k] = system[ROWS, 0, k]
    for i in range(n):
        for k in range(n):
            for r in range(n):
                system[_OMEGA, i, k] -= system[_SHIFT, r, i] * system[_FOLLOW, k, r]


@inlined
def _factor_of_omega(n: int, damping: float, system: Floats) -> bool:
    """Factor the matrix of omega with its diagonal raised by a part."""
    for i in range(n):
        for k in range(i + 1):
            system[_SPARE, i, k] = system[_OMEGA, i, k]
        system[_SPARE, i, i] *= 1.0 + damping
    return factor(system, _SPARE, n)


@inlined
def _step(n: int, s: int, damping: float, system: Floats) -> tuple[float, float]:
    """Set up the step of omega; return its largest part times s, and the gain in the sum of squares.

    The gain is negative where there is no such step. Steps are at most half a bin.
    """
    if not _factor_of_omega(n, damping, system):
        return 0.0, -1.0
    for i in range(n):
        system[ROWS, 0, i] = system[_OMEGA, i, n]
    solve(system, _SPARE, n, 0)
    gain, largest = 0.0, 0.0
    for i in range(n):
        gain += system[ROWS, 0, i] * system[_OMEGA, i, n]
        largest = max(largest, s * abs(system[ROWS, 0, i]))
    if largest > _LONGEST:
        for i in range(n):
            system[ROWS, 0, i] *= _LONGEST / largest
    return largest, gain


@summing_kernel
def refine(
    n: int,
    z: Single,
    j: int,
    weights: Single,
    sums: Floats,
    m: int,
    first: int,
    noise: float,
    states: Floats,
    tables: Single,
    left: Single,
    system: Floats,
) -> float:
    """Fit n returns from a start by damped Gauss-Newton and return the weighted sum of squares.

    `noise` is the variance of z; the other parameters are those of `evaluate`, of
    which the last three belong to the last evaluation. The variances of omega are written for unit noise.
    """
    s = z.shape[2]
    lowest, damping, retreats, retreated = np.inf, 0.0, 0, False
    done = _ONE_DONE if n == 1 else _DONE
    for iteration in range(_ITERATIONS + 1):
        if iteration == _ITERATIONS:
            copy_state(n, states, 1, states, 0)
        squares = evaluate(n, z, j, weights, sums, m, first, states, tables, left, system)
        if squares == np.inf and lowest == np.inf:
            return squares
        if squares > (1.0 + 1e-5) * lowest and iteration < _ITERATIONS:
            # Back to the best point, and from there a shorter step.
            copy_state(n, states, 1, states, 0)
            damping, retreated = max(8.0 * damping, 0.1), True
            retreats += 1
            continue
        lowest = squares
        copy_state(n, states, 0, states, 1)
        if not retreated:
            damping = damping / 8.0 if damping > 0.02 else 0.0
        retreated = False
        largest, gain = _step(n, s, damping, system)
        if gain < 0.0 or retreats > _RETREATS or iteration == _ITERATIONS:
            break
        for i in range(n):
            turn(states, 0, i, system[ROWS, 0, i])
        if damping == 0.0 and (largest < done or gain < _NEGLIGIBLE * noise):
            _follow(n, system, states)
            lowest -= gain
            break
    positive = _factor_of_omega(n, 0.0, system)
    for i in range(n):
        for k in range(n):
            system[ROWS, 0, k] = 1.0 if k == i else 0.0
        if positive:
            solve(system, _SPARE, n, 0)
        states[0, VARIANCE, i] = system[ROWS, 0, i] if positive else np.inf
    return max(lowest, 0.0)


@inlined
def _follow(n: int, system: Floats, states: Floats) -> None:
    """Let the amplitudes follow the last, small step of omega."""
    if n == 1:
        return  # its slope is zero
    for k in range(n):
        change = 0.0
        for i in range(n):
            change += system[_FOLLOW, i, k] * states[0, AMPLITUDE, i] * system[ROWS, 0, i]
        system[ROWS, 1, k] = change
    for k in range(n):
        states[0, AMPLITUDE, k] += system[ROWS, 1, k]


@inlined
def copy_state(n: int, source: Floats, p: int, target: Floats, q: int) -> None:
    """Copy n returns of one state to another."""
    for k in range(source.shape[1]):
        for i in range(n):
            target[q, k, i] = source[p, k, i]
