"""Temporal phase unwrapping over any list of fringe densities, and the phase gradient omega.

Every wrapped phase is omega t modulo 2 pi, with t the density and omega within -pi .. pi. The fringe orders
come one after the other, from one fringe across the projector up to every density, as `unwrapping_plan` says.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, inf, pi, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel
from sms_jobs.metrology.phase.frequency_search import find_orders
from sms_jobs.metrology.phase.phase_stepping import (
    add_frame,
    mark_saturated,
    phase_and_power,
    stepping_weights,
)
from sms_jobs.metrology.phase.unwrapping_plan import can_climb, unwrapping_plan

_AMBIGUOUS = 0.5 * pi  # half way to the next fringe order
_GUESS = 4.0  # predicted standard deviations of a rung that must fit into pi


@dataclass(frozen=True)
class PhaseGradient:
    """What unwrapping says of every pixel, for one orientation; each (rows, columns).

    Attributes
    ----------
    omega, omega_sigma
        Phase gradient in rad per fringe, in -pi .. pi, and its standard deviation from the noise model.
    modulation
        Root mean square of B over all densities, in grey levels; the saturated ones too, so that the map
        has no edges where densities drop out of the fit.
    phase_error
        Residual of the phase against the fringe density in rad, as an estimate of the standard deviation
        of one phase: expected to be `phase_sigma` of noise and modulation. NaN where one density is fitted.
    mean_intensity
        Of all frames, in grey levels.
    fitted
        Number of densities in the fit.
    saturated
        True where too few densities are free of saturated frames; omega is NaN there.
    ambiguous
        True where the fringe orders contradict each other or are lost in noise.
    """

    omega: Floats
    omega_sigma: Singles
    modulation: Singles
    phase_error: Singles
    mean_intensity: Singles
    fitted: NDArray[np.uint8]
    saturated: Mask
    ambiguous: Mask


@dataclass(frozen=True)
class CoarseGradient:
    """What is known of the phase gradient before any fringe is looked at, as from a Gray code.

    Attributes
    ----------
    omega
        (rows, columns) in rad per fringe; NaN where it is not known.
    half_width
        Largest distance of the true value from `omega`, in rad per fringe: half a stripe of the code.
    """

    omega: Floats
    half_width: float


@inner
@uncounted_kernel
def _climb(
    below: Floats,
    phase_a: Floats,
    phase_b: Floats,
    factors: Floats,
    density: float,
    omega: Floats,
    worst: Floats,
) -> None:
    """Unwrap one rung of one row by the omega of the rung below it; keep the largest correction."""
    a, b, over = factors[0], factors[1], 1.0 / density
    for j in range(omega.size):
        predicted = below[j] * density
        residual = a * phase_a[j] + b * phase_b[j] - predicted
        residual -= 2.0 * pi * np.rint(residual * (0.5 / pi))
        omega[j] = (predicted + residual) * over
        worst[j] = max(worst[j], abs(residual))


@inner
@uncounted_kernel
def _add_to_fit(omega: Floats, t: float, power: Floats, moments: Floats) -> None:
    """Add one density of one row to the sums of B^2 t phi, B^2 t^2, B^2 and the number of densities."""
    for j in range(omega.size):
        w = power[j]
        wtt = w * t * t
        moments[0, j] += wtt * omega[j]
        moments[1, j] += wtt
        moments[2, j] += w
        moments[3, j] += 1.0 if w > 0.0 else 0.0


@inner
@uncounted_kernel
def _add_residual(rung: Floats, t: float, power: Floats, omega: Floats, squares: Floats) -> None:
    """Add B^2 (phi - omega t)^2 of one density of one row."""
    for j in range(omega.size):
        residual = (rung[j] - omega[j]) * t
        squares[j] += power[j] * residual * residual


@inner
@uncounted_kernel
def _finish(
    moments: Floats, squares: Floats, omega: Floats, maps: Singles, noise_variance: Floats, q: int, least: int
) -> None:
    """Write omega, its standard deviation and the phase error of one row; NaN with too few densities.

    `maps` is (3, columns): the standard deviation, the modulation, which is there already, the error.
    """
    for j in range(omega.size):
        n = moments[3, j]
        enough = n >= least
        weight = moments[2, j] if enough else np.nan
        omega[j] = omega[j] - 2.0 * pi * np.rint(omega[j] * (0.5 / pi)) if enough else np.nan
        maps[0, j] = np.sqrt(2.0 / q * noise_variance[j] / moments[1, j]) if enough else np.nan
        maps[2, j] = np.sqrt(squares[j] / weight * n / (n - 1.0)) if n > 1.0 else np.nan


@inner
@uncounted_kernel
def _mark_ambiguous(
    worst: Floats,
    limits: tuple[float, float],
    modulation: Singles,
    noise_variance: Floats,
    q: int,
    ambiguous: NDArray[np.uint8],
) -> None:
    """Write 1 where fringe orders of one row contradict each other or are lost in noise, else 0.

    `worst` is (2, columns): the largest corrections of the lowest rungs and of the others, in rad; `limits`
    are those of `_unwrap_rows`.
    """
    amplification, furthest = limits
    for j in range(ambiguous.size):
        spread = amplification * np.sqrt(2.0 / q * noise_variance[j]) / modulation[j]
        lost = worst[1, j] > _AMBIGUOUS or _GUESS * spread > pi or worst[0, j] > furthest
        ambiguous[j] = 1 if lost else 0


@kernel
def _unwrap_rows(
    frames: NDArray[Any],
    weights: Floats,
    densities: Floats,
    rungs: tuple[Ints, Ints, Floats, Ints, Floats, Ints],
    camera: tuple[int, float, float],
    limits: tuple[float, float],
    coarse: Floats,
    start: int,
    omega: Floats,
    maps: Singles,
    flags: NDArray[np.uint8],
) -> None:
    """Unwrap a block of rows, frames (densities * q, block, columns), into whole maps from row `start` on.

    omega is (rows, columns); maps (4, rows, columns) are sigma, modulation, phase error and mean; flags
    (2, rows, columns) the densities in the fit, and 1 where the fringe orders are ambiguous. `weights` are
    (densities, 2, q), `limits` the amplification and the largest correction of `coarse`, which predicts the
    lowest rungs; (0, 0) for no prediction.
    """
    first, second, factors, below, rung_density, top = rungs
    full_scale, gain, read_noise = camera
    n, q, columns = densities.size, weights.shape[2], frames.shape[2]
    phase, power = np.empty((n, columns)), np.empty((n, columns))
    climbed = np.zeros((rung_density.size + 1, columns))  # the last stays 0: no prediction
    quadratures, moments = np.empty((2, columns)), np.empty((4, columns))
    total, squares, all_power = np.empty(columns), np.empty(columns), np.empty(columns)
    worst = np.empty((2, columns))
    for block_row in range(frames.shape[1]):
        row = start + block_row
        total[:] = 0.0
        all_power[:] = 0.0
        for i in range(n):
            quadratures[:] = 0.0
            for k in range(q):
                add_frame(
                    frames[i * q + k, block_row],
                    weights[i, 0, k],
                    weights[i, 1, k],
                    quadratures[0],
                    quadratures[1],
                    total,
                )
            phase_and_power(quadratures[0], quadratures[1], phase[i], power[i], all_power)
            for k in range(q):
                mark_saturated(frames[i * q + k, block_row], full_scale, power[i])
        worst[:] = 0.0
        if coarse.size:
            for j in range(columns):
                climbed[rung_density.size, j] = coarse[row, j]
        for m in range(rung_density.size):
            _climb(
                climbed[below[m]],
                phase[first[m]],
                phase[second[m]],
                factors[m],
                rung_density[m],
                climbed[m],
                worst[1 if below[m] >= 0 else 0],
            )
        moments[:] = 0.0
        squares[:] = 0.0
        for i in range(n):
            _add_to_fit(climbed[top[i]], densities[i], power[i], moments)
        for j in range(columns):
            omega[row, j] = moments[0, j] / moments[1, j]
            total[j] /= n * q
            maps[1, row, j] = np.sqrt(all_power[j] / n)
            maps[3, row, j] = total[j]
        for i in range(n):
            _add_residual(climbed[top[i]], densities[i], power[i], omega[row], squares)
        for j in range(columns):
            flags[0, row, j] = np.uint8(moments[3, j])
            total[j] = read_noise * read_noise + gain * total[j]
        _finish(moments, squares, omega[row], maps[:3, row], total, q, min(2, n))
        _mark_ambiguous(worst, limits, maps[1, row], total, q, flags[1, row])


def _turned_weights(steps: int, offsets: tuple[float, ...]) -> Floats:
    """Return the weights of every density, (densities, 2, q), that take an offset off its phase."""
    cosine, sine = stepping_weights(steps)
    turned = [(c * cosine + s * sine, c * sine - s * cosine) for c, s in ((cos(o), sin(o)) for o in offsets)]
    return np.array(turned)


def _furthest_correction(expected: float) -> float:
    """Return the largest correction of a coarse prediction that is believed, in rad; raise for too coarse.

    Half way between what a true code needs and pi, beyond which a fringe order is wrong; a tenth of a fringe
    order stays out at least, where a stripe as wide as a fringe may have been misread.
    """
    if expected > pi * (1.0 + 1e-9):
        raise InvalidInput(
            f"a stripe of the code is {expected / pi:.3g} times as wide as a fringe, but may be as wide "
            "at most: give finer code patterns, or a lower fringe density"
        )
    return min(0.5 * (pi + expected), 0.9 * pi)


def unwrap(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    steps: int,
    *,
    full_scale: int,
    gain: float,
    read_noise: float,
    offsets: tuple[float, ...] = (),
    coarse: CoarseGradient | None = None,
    threads: int = 1,
) -> PhaseGradient:
    """Find the phase gradient of every pixel from the frames of one orientation.

    Parameters
    ----------
    frames
        (densities * steps, rows, columns), uint8 or uint16, densities slower than steps.
    densities
        Fringes across the projector, any list that leaves omega unambiguous: see `unwrapping_plan`, and
        `frequency_search` for those that differ from each other by no single fringe.
    steps
        Phase steps a density, at least 3.
    full_scale
        Grey level from which on a frame is saturated. Such a frame still tells the fringe order, but its
        density is left out of the pixel's fit as long as two densities (or the only one) remain.
    gain, read_noise
        Noise model: variance = read_noise^2 + gain * grey level, in grey levels; taken at the mean level,
        which is exact in the mean over the phase (for q >= 4 at every phase).
    offsets
        What each density's pattern adds to the phase omega t, in rad; none if empty.
    coarse
        What a code beside the fringes tells: the densities need not be unambiguous then.
    threads
        Number of threads; the result does not depend on it.

    Returns
    -------
    Maps of the size of a frame.

    Notes
    -----
    omega = sum B_t^2 t phi_t / sum B_t^2 t^2, the least-squares slope through the origin (thesis section
    2.3.2). A phase has the variance 2 sigma^2 / (q B_t^2), so the weights B_t^2 give the least variance
    wherever blur lowers the modulation of dense fringes; where it does not, they cost a part of the order
    of (sigma / B)^2, since the noise of B_t is independent of that of phi_t. Then
    sigma_omega = sigma sqrt(2 / q) / sqrt(sum B_t^2 t^2), or sigma / (B sqrt(q / 2 sum t^2)) for one B.

    A coarse gradient of half width h predicts the phase of the lowest density t to within h t, which must be
    at most pi; a correction well beyond, or close to pi, is an ambiguity.

    Raises `InvalidInput` for fewer than three steps, for an ambiguous list, for a wrong number of frames or
    offsets, and for a code that is coarser than the fringes.
    """
    if len(frames) != len(densities) * steps:
        raise InvalidInput(
            f"{len(densities)} fringe densities of {steps} steps make {len(densities) * steps} frames, "
            f"not {len(frames)}: check the fringe sequence"
        )
    weights = _turned_weights(steps, offsets or (0.0,) * len(densities))
    if len(weights) != len(densities):
        raise InvalidInput(f"{len(densities)} fringe densities have as many offsets, not {len(weights)}")
    if coarse is None and len(densities) > 1 and not can_climb(densities):
        found = find_orders(frames, densities, weights, gain=gain, read_noise=read_noise, threads=threads)
        coarse = CoarseGradient(found, 0.0)
    plan = unwrapping_plan(densities, coarse is not None)
    furthest = inf if coarse is None else _furthest_correction(coarse.half_width * min(densities))
    rows, columns = frames.shape[1:]
    predicted = np.empty((0, columns)) if coarse is None else np.nan_to_num(coarse.omega)
    omega = np.empty((rows, columns))
    maps = np.empty((4, rows, columns), np.float32)
    flags = np.empty((2, rows, columns), np.uint8)
    rungs = (plan.first, plan.second, plan.factors, plan.below, plan.density, plan.top)
    camera = (full_scale, float(gain), float(read_noise))

    def work(start: int, stop: int) -> None:
        _unwrap_rows(
            np.ascontiguousarray(frames[:, start:stop]),
            weights,
            np.array(densities, dtype=np.float64),
            rungs,
            camera,
            (plan.amplification, furthest),
            predicted,
            start,
            omega,
            maps,
            flags,
        )

    in_row_blocks(work, rows, threads, block=16)
    least = min(2, len(densities))
    ambiguous = flags[1].astype(bool)
    if coarse is not None:
        ambiguous |= np.isnan(coarse.omega)
    return PhaseGradient(omega, maps[0], maps[1], maps[2], maps[3], flags[0], flags[0] < least, ambiguous)
