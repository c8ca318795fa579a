"""The least-squares fit of any number of returns to the signal of one pixel, in plain code.

The model is z(t) = g(t) sum_i a_i exp(i omega_i t) with real a_i > 0, since every return's phase is zero at
t = 0 (known origin), and g the modulation transfer. The amplitudes are linear and are solved for at every
omega (variable projection); omega moves by Gauss-Newton on what remains, damped where that does not help.
With p_i = a_i d omega_i the normal equations do not depend on the amplitudes:

    [ C   S ] [ d a ]   [ 0 ]    C_ij = sum v cos((omega_i - omega_j) t)       v = w g^2
    [ S^T K ] [  p  ] = [ q ]    S_ij = sum v t sin((omega_i - omega_j) t)     u = w g
                                 K_ij = sum v t^2 cos((omega_i - omega_j) t)

and C a = h, with h_i = Re sum u z exp(-i omega_i t), q_i = Im sum u t r exp(-i omega_i t), r the residual.
`batched_fit` does the same for one and two returns of many pixels at once, and is tested against this. Sums
over t are in single precision, of products that do not cancel; small systems are in double.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import inlined, inner, summing_kernel
from sms_jobs.metrology.phase.ranging.weights import Sums, Weights

# Columns of estimates, (returns, 4): omega, amplitude, variance of omega for unit noise, variance inside.
OMEGA, AMPLITUDE, VARIANCE, SPREAD = range(4)
COLUMNS = 4

_ITERATIONS = 14
_LONGEST = 3.0  # step x s: half a bin
_RETREATS = 6
_ONE_DONE = 0.03  # step x s of one return after which no further one is needed: what is left is its cube
_DONE = 0.01  # the same for several returns, where it is the square
_NEGLIGIBLE = 1e-2  # gain in chi-square that is not worth another step
_SINGULAR = 1e-12  # part of the diagonal below which a pivot is none


class Fit(NamedTuple):
    """Buffers of a fit of up to n returns.

    Attributes
    ----------
    rotors
        cos and sin of omega t, (n, 2, padded).
    residual
        What the model leaves of the signal, (2, padded).
    normal, factor
        The matrix of the normal equations and its Cholesky factor, (2 n, 2 n), their lower triangles.
    slope, step
        The right-hand side, and d a and p, (2 n,).
    best
        The best estimates so far, (n, 4).
    """

    rotors: Singles
    residual: Singles
    normal: Floats
    factor: Floats
    slope: Floats
    step: Floats
    best: Floats


@inner
@summing_kernel
def new_fit(returns: int, padded: int) -> Fit:
    """Return the buffers of a fit."""
    return Fit(
        np.zeros((returns, 2, padded), np.float32),
        np.zeros((2, padded), np.float32),
        np.zeros((2 * returns, 2 * returns)),
        np.zeros((2 * returns, 2 * returns)),
        np.zeros(2 * returns),
        np.zeros(2 * returns),
        np.zeros((returns, COLUMNS)),
    )


@inlined
def write_rotors(omega: float, first: int, rotors: Singles) -> None:
    """Write cos and sin of omega t, t = first, first + 1, ..: what is there, turned, is next."""
    c, s = cos(omega), sin(omega)
    rotors[0, 0] = 1.0 if first == 0 else c
    rotors[1, 0] = 0.0 if first == 0 else s
    size, done = rotors.shape[1], 1
    while done < size:
        p, q = np.float32(c), np.float32(s)
        for t in range(min(done, size - done)):
            rotors[0, done + t] = p * rotors[0, t] - q * rotors[1, t]
            rotors[1, done + t] = q * rotors[0, t] + p * rotors[1, t]
        c, s = c * c - s * s, 2.0 * c * s
        done *= 2


@inlined
def _in_phase(z: Singles, weights: Singles, rotors: Singles) -> float:
    """Return Re sum w z exp(-i omega t)."""
    total = np.float32(0.0)
    for t in range(z.shape[1]):
        total += weights[t] * (z[0, t] * rotors[0, t] + z[1, t] * rotors[1, t])
    return float(total)


@inlined
def _in_quadrature(z: Singles, weights: Singles, rotors: Singles) -> float:
    """Return Im sum w z exp(-i omega t)."""
    total = np.float32(0.0)
    for t in range(z.shape[1]):
        total += weights[t] * (z[1, t] * rotors[0, t] - z[0, t] * rotors[1, t])
    return float(total)


@inlined
def _overlap(a: Singles, b: Singles, v: Singles) -> tuple[float, float, float]:
    """Return C, S and K of two returns from their rotors."""
    over, shift, curve = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for t in range(v.shape[1]):
        c = a[0, t] * b[0, t] + a[1, t] * b[1, t]
        s = a[1, t] * b[0, t] - a[0, t] * b[1, t]
        over += v[0, t] * c
        shift += v[1, t] * s
        curve += v[2, t] * c
    return float(over), float(shift), float(curve)


@inner
@summing_kernel
def power(z: Singles, precision: Singles) -> float:
    """Return sum w |z|^2."""
    total = np.float32(0.0)
    for t in range(z.shape[1]):
        total += precision[t] * (z[0, t] * z[0, t] + z[1, t] * z[1, t])
    return float(total)


@inlined
def _subtract(z: Singles, transfer: Singles, estimates: Floats, fit: Fit) -> None:
    """Write what returns, whose rotors are written, leave of a signal."""
    residual, rotors = fit.residual, fit.rotors
    for part in range(2):
        for t in range(z.shape[1]):
            residual[part, t] = z[part, t]
    for i in range(estimates.shape[0]):
        amplitude = np.float32(estimates[i, AMPLITUDE])
        for part in range(2):
            for t in range(z.shape[1]):
                residual[part, t] -= amplitude * transfer[t] * rotors[i, part, t]


@inner
@summing_kernel
def subtract(z: Singles, transfer: Singles, first: int, estimates: Floats, fit: Fit) -> None:
    """Write rotors of returns, and what these leave of a signal, to the buffers of a fit."""
    for i in range(estimates.shape[0]):
        write_rotors(estimates[i, OMEGA], first, fit.rotors[i])
    _subtract(z, transfer, estimates, fit)


@inlined
def factorize(matrix: Floats, start: int, n: int, damping: float, factor: Floats) -> bool:
    """Write the rows from `start` on of the Cholesky factor of a matrix; False where it is not positive.

    What the rows before leave of the diagonal is raised by the part `damping`.
    """
    for i in range(start, n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(min(start, j)):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                total *= 1.0 + damping
            for k in range(start, j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > _SINGULAR * matrix[i, i]:
                factor[i, i] = np.sqrt(total)
            else:
                return False
    return True


@inlined
def substitute(factor: Floats, n: int, right: Floats) -> None:
    """Replace the first n of a right-hand side by the solution of the equations with this factor."""
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@inlined
def _evaluate(z: Singles, weights: Weights, sums: Sums, first: int, estimates: Floats, fit: Fit) -> float:
    """Solve for the amplitudes at omega and set up the equations of a step, their right-hand side in `step`.

    Returns the weighted sum of squares of the residual, infinite where two returns are one.
    """
    n, normal, rotors, step = estimates.shape[0], fit.normal, fit.rotors, fit.step
    for i in range(n):
        write_rotors(estimates[i, OMEGA], first, rotors[i])
        step[i] = _in_phase(z, weights.u[0], rotors[i])
        normal[i, i], normal[n + i, n + i], normal[n + i, i] = sums.v, sums.vtt, 0.0
        for k in range(i):
            over, shift, curve = _overlap(rotors[i], rotors[k], weights.v)
            normal[i, k], normal[n + i, n + k] = over, curve
            normal[n + k, i], normal[n + i, k] = shift, -shift
    if not factorize(normal, 0, n, 0.0, fit.factor):
        return np.inf
    substitute(fit.factor, n, step)
    for i in range(n):
        estimates[i, AMPLITUDE] = step[i]
    _subtract(z, weights.transfer, estimates, fit)
    for i in range(n):
        step[i], step[n + i] = 0.0, _in_quadrature(fit.residual, weights.u[1], rotors[i])
    return power(fit.residual, weights.precision)


@inlined
def _take_step(n: int, size: int, damping: float, estimates: Floats, fit: Fit) -> tuple[float, float]:
    """Move omega by a step of half a bin at most; return its largest part times s, and its gain.

    The gain in the sum of squares is negative where there is no such step. `fit.step` becomes the step.
    """
    if not factorize(fit.normal, n, 2 * n, damping, fit.factor):
        return 0.0, -1.0
    for i in range(2 * n):
        fit.slope[i] = fit.step[i]
    substitute(fit.factor, 2 * n, fit.step)
    gain, largest = 0.0, 0.0
    for i in range(n):
        gain += fit.step[n + i] * fit.slope[n + i]
        largest = max(largest, size * abs(fit.step[n + i] / estimates[i, AMPLITUDE]))
    part = min(1.0, _LONGEST / largest) if largest > 0.0 else 1.0
    for i in range(n):
        fit.step[i] *= part
        estimates[i, OMEGA] += part * fit.step[n + i] / estimates[i, AMPLITUDE]
    return largest, gain


@inlined
def _write_variances(n: int, estimates: Floats, fit: Fit) -> None:
    """Write the variances of omega for unit noise, the squares of the columns of the factor's inverse."""
    factor, column = fit.factor, fit.slope
    positive = factorize(fit.normal, n, 2 * n, 0.0, factor)
    for i in range(n, 2 * n):
        variance = 0.0
        for k in range(i, 2 * n):
            total = 1.0 if k == i else 0.0
            for m in range(i, k):
                total -= factor[k, m] * column[m]
            column[k] = total / factor[k, k]
            variance += column[k] ** 2
        estimates[i - n, VARIANCE] = variance / estimates[i - n, AMPLITUDE] ** 2 if positive else np.inf


@inlined
def copy_estimates(source: Floats, target: Floats, n: int) -> None:
    """Copy n returns."""
    for i in range(n):
        for k in range(COLUMNS):
            target[i, k] = source[i, k]


@inner
@summing_kernel
def fit_returns(
    z: Singles, weights: Weights, sums: Sums, first: int, variance: float, estimates: Floats, fit: Fit
) -> float:
    """Fit returns to the signal of one pixel by damped Gauss-Newton.

    Parameters
    ----------
    z
        (2, padded), real and imaginary part, 0 where a density is left out.
    weights, sums, first
        What densities weigh, and t of the first one.
    variance
        That of z.
    estimates
        (n, 4): omega is the start, and becomes the end, with amplitude and variance of omega for unit noise.
    fit
        Of `new_fit` for n returns or more; its rotors and residual are left behind for others.

    Returns
    -------
    The weighted sum of squares of the residual, infinite where two returns are one.
    """
    n = estimates.shape[0]
    lowest, damping, retreats, retreated, ended = np.inf, 0.0, 0, False, False
    done = _ONE_DONE if n == 1 else _DONE
    for iteration in range(_ITERATIONS + 1):
        if iteration == _ITERATIONS:
            copy_estimates(fit.best, estimates, n)
        squares = _evaluate(z, weights, sums, first, estimates, fit)
        if squares == np.inf and lowest == np.inf:
            return squares
        if squares > (1.0 + 1e-5) * lowest and iteration < _ITERATIONS:
            # Back to the best point, and from there a shorter step.
            copy_estimates(fit.best, estimates, n)
            damping, retreated = max(8.0 * damping, 0.1), True
            retreats += 1
            continue
        lowest = squares
        copy_estimates(estimates, fit.best, n)
        if not retreated:
            damping = damping / 8.0 if damping > 0.02 else 0.0
        retreated = False
        if retreats > _RETREATS or iteration == _ITERATIONS:
            break
        largest, gain = _take_step(n, z.shape[1], damping, estimates, fit)
        if gain < 0.0:
            break
        if damping == 0.0 and (largest < done or gain < _NEGLIGIBLE * variance):
            lowest -= gain
            ended = True
            break
    _write_variances(n, estimates, fit)
    for i in range(n if ended else 0):  # amplitudes follow the last, small step
        estimates[i, AMPLITUDE] += fit.step[i]
    return max(lowest, 0.0)


@inner
@summing_kernel
def write_spread(weights: Weights, sums: Sums, estimates: Floats, fit: Fit) -> None:
    """Write the variance of omega inside each return, whose residual is that of `subtract`.

    A spread of variance p lets the amplitude fall as 1 - p t^2 / 2; p is fitted to the residual together
    with the amplitude.
    """
    for i in range(estimates.shape[0]):
        fall = _in_phase(fit.residual, weights.u[2], fit.rotors[i])
        estimates[i, SPREAD] = -2.0 * fall / (estimates[i, AMPLITUDE] * sums.spread)
