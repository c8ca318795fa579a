"""Phase, modulation and mean level from phase-stepped frames, for any number of steps from three on.

With I_k = A + B cos(phi + 2 pi k / q), k = 0 .. q-1, the fundamental of the q frames is the complex number
z = B exp(i phi) (thesis Eq. (1.17) is its angle for q = 4). The row functions are kernels that fill buffers
of one image row, so that other kernels can be built from them without storing z.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel


def stepping_weights(steps: int) -> Floats:
    """Return the weights that turn q frames into B cos(phi) and B sin(phi), (2, q).

    C = 2/q sum_k I_k cos(2 pi k / q), S = -2/q sum_k I_k sin(2 pi k / q); the constant A drops out.
    Raises `InvalidInput` for fewer than three steps.
    """
    if steps < 3:
        raise InvalidInput(f"phase stepping needs at least 3 steps, not {steps}: add phase steps")
    angles = 2.0 * pi * np.arange(steps) / steps
    return np.stack([np.cos(angles), -np.sin(angles)]) * (2.0 / steps)


def phase_sigma(noise: Any, modulation: Any, steps: int) -> Any:
    """Return the standard deviation of one wrapped phase, in rad: sqrt(2 / q) sigma / B.

    `noise` and `modulation` are in grey levels, scalars or arrays of one shape. First order in sigma / B.
    """
    return sqrt(2.0 / steps) * noise / modulation


def _arctangent_coefficients(terms: int = 12) -> tuple[float, ...]:
    """Return the polynomial p with arctan(x) = x p(x^2) on 0 <= x <= 1.

    It is the Chebyshev series 2 sum_k (-1)^k (sqrt(2) - 1)^(2k+1) / (2k+1) T_(2k+1)(x), truncated: each
    term is 0.17 of the one before, and 12 of them leave less than 1e-10 rad.
    """
    series = np.zeros(2 * terms)
    for k in range(terms):
        series[2 * k + 1] = 2.0 * (-1.0) ** k * (sqrt(2.0) - 1.0) ** (2 * k + 1) / (2 * k + 1)
    return tuple(float(c) for c in chebyshev.cheb2poly(series)[1::2])


_ARCTANGENT = _arctangent_coefficients()
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10, _C11 = _ARCTANGENT


@inner
@uncounted_kernel
def angle(sine: float, cosine: float) -> float:
    """Return the angle of (cosine, sine) in -pi .. pi, 0 for (0, 0), to 1e-10 rad.

    Free of branches, so that loops over pixels become vector instructions; the C library's `atan2` is
    some ten times slower.
    """
    across = abs(sine)
    along = abs(cosine)
    large = max(across, along)
    small = min(across, along)
    ratio = small / (large if large > 0.0 else 1.0)
    x = ratio * ratio
    p = _C8 + x * (_C9 + x * (_C10 + x * _C11))
    p = _C4 + x * (_C5 + x * (_C6 + x * (_C7 + x * p)))
    p = ratio * (_C0 + x * (_C1 + x * (_C2 + x * (_C3 + x * p))))
    p = 0.5 * pi - p if across > along else p
    p = pi - p if cosine < 0.0 else p
    return -p if sine < 0.0 else p


@inner
@uncounted_kernel
def add_frame(
    frame: NDArray[Any], weight_c: float, weight_s: float, cosine: Floats, sine: Floats, total: Floats
) -> None:
    """Add one row of one frame, (columns,), to the sums of C, S and the level."""
    for j in range(frame.size):
        level = np.float64(frame[j])
        cosine[j] += weight_c * level
        sine[j] += weight_s * level
        total[j] += level


@inner
@uncounted_kernel
def phase_and_power(cosine: Floats, sine: Floats, phase: Floats, power: Floats, total: Floats) -> None:
    """Turn one row of C and S into the wrapped phase in rad and B^2, and add B^2 to the total."""
    for j in range(cosine.size):
        phase[j] = angle(sine[j], cosine[j])
        power[j] = cosine[j] * cosine[j] + sine[j] * sine[j]
        total[j] += power[j]


@inner
@uncounted_kernel
def mark_saturated(frame: NDArray[Any], full_scale: int, power: Floats) -> None:
    """Take all weight from a row's pixels that are at full scale in one of the frames behind them."""
    for j in range(frame.size):
        power[j] = 0.0 if frame[j] >= full_scale else power[j]
