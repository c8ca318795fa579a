"""How the returns of one pixel are found from the peaks of its transform: by a joint fit, or one by one."""

from __future__ import annotations

from math import cos, pi, sin
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.phase.ranging.fit import (
    AMPLITUDE,
    COS,
    NT,
    NTT,
    OMEGA,
    SIN,
    SPREAD,
    UT,
    UTT,
    VARIANCE,
    VT,
    VT4,
    VTT,
    G,
    N,
    P,
    U,
    V,
    copy_state,
    in_phase,
    in_quadrature,
    power,
    refine,
    rotors,
    subtract,
    turn,
)

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

CLOSE = 1.6  # bins; returns nearer than this are also started from a split of one
_SPLIT = 0.3  # bins to either side


@kernel
def begin(states: Floats, i: int, omega: float) -> None:
    """Put return i of the state at hand at an omega."""
    states[0, OMEGA, i] = omega
    states[0, COS, i] = cos(omega)
    states[0, SIN, i] = sin(omega)


@kernel
def wrapped(angle: float) -> float:
    """Return an angle in -pi .. pi."""
    return float(angle - 2.0 * pi * np.rint(angle * (0.5 / pi)))


@kernel
def _offset_of_real_peak(spectrum: Single, k: int, lane: int) -> float:
    """Return how far a peak of Re H lies from its highest sample, -0.5 .. 0.5 samples.

    The peak is a sin(u) / u sampled at u = pi apart, for which the neighbour's share is the offset.
    """
    n = spectrum.shape[1]
    here = spectrum[k & 1, k >> 1, lane]
    before, after = (k - 1) & (2 * n - 1), (k + 1) & (2 * n - 1)  # n is a power of two
    left, right = spectrum[before & 1, before >> 1, lane], spectrum[after & 1, after >> 1, lane]
    beside = max(max(left, right), 0.0)
    offset = beside / (beside + here) if here > 0.0 else 0.0
    return float(offset if right > left else -offset)


@kernel
def start_of_real_peak(spectrum: Single, k: int, lane: int) -> float:
    """Return omega of a peak of Re H between its samples."""
    return wrapped(pi / spectrum.shape[1] * (k + _offset_of_real_peak(spectrum, k, lane)))


@kernel
def height_of_real_peak(spectrum: Single, k: int, lane: int) -> float:
    """Return the height of a peak of Re H between its samples."""
    u = pi * _offset_of_real_peak(spectrum, k, lane)
    return float(spectrum[k & 1, k >> 1, lane] / (1.0 - u * u / 6.0 * (1.0 - u * u / 20.0)))


@kernel
def start_of_modulus_peak(spectrum: Single, k: int, lane: int, interpolated: bool) -> float:
    """Return omega of a peak of |H|: the whole frequency, or where the phase vanishes, thesis Eq. (6.7)."""
    n = spectrum.shape[1]
    if not interpolated:
        return wrapped(2.0 * pi / n * k)
    before, after = (k - 1) % n, (k + 1) % n
    here_x, here_y = spectrum[0, k, lane], spectrum[1, k, lane]
    left = spectrum[0, before, lane] ** 2 + spectrum[1, before, lane] ** 2
    right = spectrum[0, after, lane] ** 2 + spectrum[1, after, lane] ** 2
    side = 1 if right > left else -1
    there_x, there_y = spectrum[0, (k + side) % n, lane], spectrum[1, (k + side) % n, lane]
    # The phase falls by nearly pi a bin and vanishes at the peak; here it is within pi / 2 but for a jump.
    change = np.arctan2(there_y * here_x - there_x * here_y, there_x * here_x + there_y * here_y)
    change = -change * side if change * side < 0.0 else 2.0 * pi - change * side
    phase = np.arctan2(here_y, here_x)
    phase = side * (phase - pi * np.rint(phase / pi))
    phase += pi if phase < -0.25 * pi else 0.0
    offset = min(max(phase / change, -0.5), 1.0)
    return wrapped(2.0 * pi / n * (k + side * offset))


@kernel
def spread(
    n: int, weights: Single, sums: Floats, m: int, work: Floats, tables: Single, left: Single, j: int
) -> None:
    """Write the variance of omega inside each return of the state at hand, that of pixel j.

    A spread of variance p lets the amplitude fall as 1 - p t^2 / 2; p is fitted to the residual together
    with the amplitude.
    """
    lever = sums[m, VT4] - sums[m, VTT] * sums[m, VTT] / sums[m, V]
    for i in range(n):
        fall = in_phase(left, j, weights, m, UTT, tables, i)
        work[0, SPREAD, i] = -2.0 * fall / (work[0, AMPLITUDE, i] * lever)


@kernel
def _nearest(n: int, omega: float, states: Floats, j: int) -> int:
    """Return which of the first n returns of state j is nearest to an omega."""
    nearest = 0
    for i in range(1, n):
        if abs(wrapped(states[j, OMEGA, i] - omega)) < abs(wrapped(states[j, OMEGA, nearest] - omega)):
            nearest = i
    return nearest


@kernel
def _all_positive(n: int, states: Floats) -> bool:
    lowest = states[0, AMPLITUDE, 0]
    for i in range(1, n):
        lowest = min(lowest, states[0, AMPLITUDE, i])
    return bool(lowest > 0.0)


@kernel
def add_jointly(
    n: int,
    z: Single,
    j: int,
    weights: Single,
    sums: Floats,
    m: int,
    first: int,
    noise: tuple[float, float, float],
    omega: float,
    squares: float,
    states: Floats,
    work: Floats,
    tables: Single,
    left: Single,
    system: Floats,
) -> float:
    """Add return n - 1 near `omega` to those of a pixel if the joint fit gains enough by it.

    `noise` is the variance of z, the threshold of the score, and the number of values; `states` (pixels, 6,
    returns) is changed where the return is significant, `work` (3, 6, returns) scratch; the others are those
    of `refine`. Returns the new weighted sum of squares, or -1 where the return is not significant.

    The fit starts from the peak of what the others leave. Two returns within half a bin are one peak, and
    leave one that is at neither; near a return the fit also starts from that return split in two, and the
    better end counts.
    """
    variance, threshold, values = noise
    one_bin = 2.0 * pi / sums[0, G]
    nearest = _nearest(n - 1, omega, states, j) if n > 1 else 0
    centre = states[j, OMEGA, nearest]
    close = n > 1 and abs(wrapped(centre - omega)) < CLOSE * one_bin
    found = np.inf
    for attempt in range(2 if close else 1):
        copy_state(n - 1, states, j, work, 0)
        split = close and attempt == 0
        if split:
            begin(work, nearest, centre - _SPLIT * one_bin)
        begin(work, n - 1, centre + _SPLIT * one_bin if split else omega)
        end = refine(n, z, j, weights, sums, m, first, variance, work, tables, left, system)
        if not _all_positive(n, work):
            end = np.inf
        if end < found:
            found = end
            copy_state(n, work, 0, work, 2)
    floor = max(variance, found / max(values - 2.0 * n, 1.0))
    if not squares - found > threshold * threshold * floor:
        return -1.0
    if end > found:
        copy_state(n, work, 2, work, 0)
        found = refine(n, z, j, weights, sums, m, first, variance, work, tables, left, system)
    spread(n, weights, sums, m, work, tables, left, j)
    copy_state(n, work, 0, states, j)
    return found


@kernel
def _climb_modulus(
    z: Single, j: int, weights: Single, m: int, first: int, work: Floats, tables: Single
) -> float:
    """Maximise |H|^2 over omega of return 0 by Newton-Raphson; return |H|. Its phase is free."""
    s = z.shape[2]
    modulus = 0.0
    for _ in range(12):
        rotors(work, 0, 0, first, tables, 0)
        re = in_phase(z, j, weights, m, U, tables, 0)
        im = in_quadrature(z, j, weights, m, U, tables, 0)
        re1 = in_phase(z, j, weights, m, UT, tables, 0)
        im1 = in_quadrature(z, j, weights, m, UT, tables, 0)
        re2 = in_phase(z, j, weights, m, UTT, tables, 0)
        im2 = in_quadrature(z, j, weights, m, UTT, tables, 0)
        modulus = np.sqrt(float(re * re + im * im))
        slope = float(re * im1 - im * re1)
        curvature = float(im1 * im1 + re1 * re1 - re * re2 - im * im2)
        step = -slope / curvature if curvature < 0.0 else np.sign(slope) * 1.5 / s
        step = min(max(step, -3.0 / s), 3.0 / s)
        turn(work, 0, 0, step)
        if abs(step) * s < 1e-3:
            break
    return modulus


@kernel
def peel(
    i: int,
    left: Single,
    j: int,
    weights: Single,
    sums: Floats,
    m: int,
    first: int,
    omega: float,
    known_origin: bool,
    states: Floats,
    work: Floats,
    tables: Single,
    rest: Single,
    system: Floats,
) -> None:
    """Fit return i of pixel j alone, from `omega`, to `left`, its signal without the others.

    The variance is that of one return, 1 / (a^2 sum v t^2) or, with a free phase, 1 / (a^2 sum v (t - c)^2),
    c the mean of t; without a window these are the bounds. `rest` is scratch of the shape of `left`.
    """
    begin(work, 0, omega)
    if known_origin:
        refine(int(np.int64(1)), left, j, weights, sums, m, first, 0.0, work, tables, rest, system)
        scatter, lever = sums[m, NTT], sums[m, VTT]
    else:
        work[0, AMPLITUDE, 0] = _climb_modulus(left, j, weights, m, first, work, tables) / sums[m, V]
        mean = sums[m, VT] / sums[m, V]
        scatter = sums[m, NTT] - 2.0 * mean * sums[m, NT] + mean * mean * sums[m, N]
        lever = sums[m, VTT] - mean * sums[m, VT]
    work[0, VARIANCE, 0] = scatter / (work[0, AMPLITUDE, 0] * lever) ** 2
    for k in range(work.shape[1]):
        states[j, k, i] = work[0, k, 0]


@kernel
def remove(
    z: Single,
    j: int,
    weights: Single,
    m: int,
    first: int,
    states: Floats,
    found: int,
    kept: int,
    tables: Single,
    left: Single,
) -> float:
    """Write pixel j without its returns but number `kept`, and return the weighted sum of its squares."""
    for t in range(z.shape[2]):
        left[j, 0, t] = z[j, 0, t]
        left[j, 1, t] = z[j, 1, t]
    for i in range(found):
        rotors(states, j, i, first, tables, i)
        if i != kept:
            subtract(states[j, AMPLITUDE, i], weights, m, tables, i, left, j)
    return float(power(left, j, weights, m, P))
