"""The fit of one return to each of `LANES` pixels at once.

Most pixels hold one return, and its fit from an interpolated peak needs a step or two. Done for all pixels
of a chunk together it costs a tenth of what it costs pixel by pixel. Whatever does not converge so is left
to the fit of single pixels.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import summing_kernel
from sms_jobs.metrology.phase.returns_fit import UT, UTT, VTT, G, U, V, W
from sms_jobs.metrology.phase.returns_transform import LANES

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

# Parts of the flat state, LANES numbers each. It is flat, and the parts constants, for the compiler to see
# that they do not overlap.
STEP_TIMES_S = 0
OMEGA = LANES
COSINE = 2 * LANES
SINE = 3 * LANES
AMPLITUDE = 4 * LANES
SLOPE = 5 * LANES
SQUARES = 6 * LANES
FALL = 7 * LANES
_C = 8 * LANES
_S = 9 * LANES
SIZE = 10 * LANES

_STEPS = 3
SMALL = 0.1  # step of omega, times s, after which the cube of it that is left does not matter


@summing_kernel
def _restart(first: int, state: Floats) -> None:
    """Put the running cos and sin of omega t to those of the first density."""
    for j in range(LANES):
        state[_C + j] = 1.0 if first == 0 else state[COSINE + j]
        state[_S + j] = 0.0 if first == 0 else state[SINE + j]


@summing_kernel
def _advance(x: Single, y: Single, t: int, u: float, ut: float, state: Floats) -> None:
    """Add one density to Re sum u z exp(-i omega t) and Im sum u t z exp(-i omega t)."""
    for j in range(LANES):
        c, s = state[_C + j], state[_S + j]
        zx, zy = np.float64(x[t, j]), np.float64(y[t, j])
        state[AMPLITUDE + j] += u * (zx * c + zy * s)
        state[SLOPE + j] += ut * (zy * c - zx * s)
        state[_C + j] = c * state[COSINE + j] - s * state[SINE + j]
        state[_S + j] = s * state[COSINE + j] + c * state[SINE + j]


@summing_kernel
def _move(v: float, vtt: float, s: float, state: Floats) -> None:
    """Turn the sums into amplitude and Gauss-Newton step of omega, half a bin at most, and go there."""
    for j in range(LANES):
        a = state[AMPLITUDE + j] / v
        step = s * state[SLOPE + j] / (vtt * max(a, 1e-30))
        step = max(min(step, 3.0), -3.0)
        state[STEP_TIMES_S + j] = step
        step /= s
        state[AMPLITUDE + j] = a + 0.5 * state[SLOPE + j] * step / v  # at the end of the step
        state[OMEGA + j] += step
        q = step * step
        ds = step * (1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0))))
        dc = 1.0 - q / 2.0 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0)))
        c, r = state[COSINE + j], state[SINE + j]
        state[COSINE + j] = c * dc - r * ds
        state[SINE + j] = r * dc + c * ds


@summing_kernel
def _remove(x: Single, y: Single, t: int, g: float, w: float, utt: float, state: Floats) -> None:
    """Take one density of the model out of the signal; add what is left to its sums."""
    for j in range(LANES):
        c, s = state[_C + j], state[_S + j]
        a = g * state[AMPLITUDE + j]
        zx, zy = np.float64(x[t, j]) - a * c, np.float64(y[t, j]) - a * s
        x[t, j] = np.float32(zx)
        y[t, j] = np.float32(zy)
        state[SQUARES + j] += w * (zx * zx + zy * zy)
        state[FALL + j] += utt * (zx * c + zy * s)
        state[_C + j] = c * state[COSINE + j] - s * state[SINE + j]
        state[_S + j] = s * state[COSINE + j] + c * state[SINE + j]


@summing_kernel
def fit_one_each(x: Single, y: Single, weights: Single, sums: Floats, first: int, state: Floats) -> None:
    """Fit one return to every pixel of a chunk.

    Parameters
    ----------
    x, y
        z(t), (densities, LANES); become what the return leaves.
    weights, sums
        (14, densities or more) of `fit_weights`, for unsaturated pixels, and their sums.
    first
        t of the first density.
    state
        (SIZE,): omega with its cos and sin is the start, and becomes the end; the amplitude, the weighted sum
        of squares, Re sum u t^2 r exp(-i omega t) of the residual r, and the last step of omega times s (by
        the cube of which it may be wrong) are written.
    """
    count = x.shape[0]
    for _ in range(_STEPS):
        _restart(first, state)
        for j in range(LANES):
            state[AMPLITUDE + j] = 0.0
            state[SLOPE + j] = 0.0
        for t in range(count):
            _advance(x, y, t, weights[U, t], weights[UT, t], state)
        _move(sums[V], sums[VTT], count, state)
        largest = 0.0
        for j in range(LANES):
            largest = max(largest, abs(state[STEP_TIMES_S + j]))
        if largest < SMALL:
            break
    _restart(first, state)
    for j in range(LANES):
        state[SQUARES + j] = 0.0
        state[FALL + j] = 0.0
    for t in range(count):
        _remove(x, y, t, weights[G, t], weights[W, t], weights[UTT, t], state)
