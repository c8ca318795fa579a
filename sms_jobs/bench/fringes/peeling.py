"""Fourier domain ranging as in the thesis: the highest |H|, one return after the other, in plain NumPy.

The studies compare it with the joint fit of returns whose phase is known at t = 0, which `range_returns` is.
It takes no account of that phase, and so has twice the error; nor of how returns overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Complexes, Floats, Mask
from sms_jobs.metrology.phase.fourier_domain_ranging import score_threshold
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.signal import Sequence, Window, ranging_sequence, window_weights

_CLIMBS = 12
_ROWS = 32  # of an image that are peeled at a time


@dataclass(frozen=True)
class Peeled:
    """Returns by peeling, (returns, rows, columns), strongest first, NaN where there is none.

    `omega` and `omega_sigma` in rad per fringe, `amplitude` in grey levels, as of `Returns`.
    """

    omega: Floats
    omega_sigma: Floats
    amplitude: Floats


@dataclass(frozen=True)
class _Signals:
    """Signals and weights of pixels, (densities, pixels), t, (densities,), and their variance, (pixels,)."""

    t: Floats
    z: Complexes
    precision: Floats
    search: Floats
    transfer: Floats
    variance: Floats


def peel_returns(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    steps: int,
    camera: GreyLevels,
    *,
    returns: int = 1,
    refinements: int = 1,
    interpolated: bool = True,
    window: Window = "none",
    significance: float = 1e-4,
    mtf: Floats | None = None,
) -> Peeled:
    """Find up to `returns` phase gradients of every pixel: thesis section 7.2.3, steps 1 to 4.

    Parameters
    ----------
    frames, densities, steps, camera, returns, significance, mtf
        As of `range_returns`.
    refinements
        How often each return is found again with the others removed (step 4).
    interpolated
        Whether a climb starts from the interpolated frequency (section 7.2.2) or the whole one (7.2.1).
    window
        Over the densities, for the search of peaks and the climb.

    Raises `InvalidInput` as `range_returns` does.
    """
    sequence = ranging_sequence(densities, steps, len(frames))
    threshold = score_threshold(significance, sequence.count)
    g = np.ones(sequence.count) if mtf is None else np.asarray(mtf, dtype=np.float64)
    search = sequence.precision * g * window_weights(window, sequence, known_origin=False)
    rows = []
    for start in range(0, frames.shape[1], _ROWS):
        part = frames[:, start : start + _ROWS]
        z, kept = _signal(part, sequence, camera.full_scale)
        mean = part.mean(axis=0, dtype=np.float64).ravel()
        signals = _Signals(
            sequence.densities,
            z,
            sequence.precision[:, None] * kept,
            search[:, None] * kept,
            g[:, None] * kept,
            2.0 / steps * camera.variance(mean),
        )
        least = kept.sum(axis=0) >= max(3, sequence.count // 4)
        found = _peel(signals, least, returns, refinements, interpolated, threshold)
        rows.append(found.reshape(3, returns, *part.shape[1:]))
    return Peeled(*np.concatenate(rows, axis=2))


def _signal(frames: NDArray[Any], sequence: Sequence, full_scale: int) -> tuple[Complexes, Floats]:
    """Return z(t) of thesis Eq. (6.4), (densities, pixels), and 1 where none of its frames is saturated."""
    shape = (sequence.count, frames[0].size)
    z, kept = np.zeros(shape, np.complex128), np.ones(shape)
    for (i, c, s), frame in zip(sequence.frames, frames, strict=True):
        z[int(i)] += (c + 1j * s) * frame.ravel()
        kept[int(i)] *= frame.ravel() < full_scale
    return z * kept, kept


def _peel(
    signals: _Signals, least: Mask, returns: int, refinements: int, interpolated: bool, threshold: float
) -> Floats:
    """Return omega, its standard deviation and amplitude, (3, returns, pixels)."""
    omega, amplitude = np.full((2, returns, least.size), np.nan)
    origin = 1.0 if signals.t[0] == 0.0 else 0.0
    values = 2.0 * (signals.precision > 0.0).sum(axis=0) - origin
    noise = np.sum(
        np.where(signals.precision > 0.0, signals.search**2, 0.0) / _positive(signals.precision), axis=0
    )
    active = least.copy()
    for sweep in range(refinements + 1 if returns > 1 else 1):
        for i in range(returns):
            active = active if sweep == 0 else np.isfinite(omega[i])
            left = _without(signals, omega, amplitude, kept=i)
            omega[i, active], amplitude[i, active] = (
                value[active] for value in _highest(signals, left, interpolated)
            )
            if sweep > 0:
                continue
            left = _without(signals, omega, amplitude)
            squares = np.sum(signals.precision * np.abs(left) ** 2, axis=0)
            floor = np.maximum(signals.variance, squares / np.maximum(values - 2.0 * (i + 1), 1.0))
            score = amplitude[i] * np.sum(signals.search * signals.transfer, axis=0)
            active &= score > threshold * np.sqrt(noise * floor)
            omega[i, ~active] = amplitude[i, ~active] = np.nan
    order = np.argsort(-np.nan_to_num(amplitude), axis=0, kind="stable")
    omega, amplitude = (np.take_along_axis(a, order, axis=0) for a in (omega, amplitude))
    return np.stack([omega, _sigma(signals) / amplitude, amplitude])


def _positive(values: Floats) -> Floats:
    return np.where(values > 0.0, values, 1.0)


def _without(signals: _Signals, omega: Floats, amplitude: Floats, kept: int = -1) -> Complexes:
    """Return the signals without their returns but number `kept`: thesis Eq. (6.8)."""
    left = signals.z.copy()
    for i in range(len(omega)):
        if i != kept:
            model = amplitude[i] * np.exp(1j * signals.t[:, None] * omega[i])
            left -= np.where(np.isfinite(omega[i]), signals.transfer * model, 0.0)
    return left


def _highest(signals: _Signals, left: Complexes, interpolated: bool) -> tuple[Floats, Floats]:
    """Return where |H| is highest, by Newton-Raphson from its highest sample, and the amplitude there."""
    t, weighted = signals.t[:, None], signals.search * left
    omega = _start(t, weighted, interpolated)
    s = t.size
    for _ in range(_CLIMBS):
        turned = weighted * np.exp(-1j * t * omega)
        h, h1, h2 = (np.sum(t**k * turned, axis=0) for k in range(3))
        slope = h.real * h1.imag - h.imag * h1.real
        curvature = np.abs(h1) ** 2 - h.real * h2.real - h.imag * h2.imag
        step = np.where(
            curvature < 0.0, -slope / np.where(curvature < 0.0, curvature, 1.0), np.sign(slope) * 1.5 / s
        )
        step = np.clip(step, -3.0 / s, 3.0 / s)
        omega = omega + step
        if np.abs(step).max() * s < 1e-3:
            break
    amplitude = np.abs(np.sum(weighted * np.exp(-1j * t * omega), axis=0))
    amplitude /= _positive(np.sum(signals.search * signals.transfer, axis=0))
    return omega - 2.0 * pi * np.rint(omega / (2.0 * pi)), amplitude


def _start(t: Floats, weighted: Complexes, interpolated: bool) -> Floats:
    """Return k of the highest |H(k)|, thesis Eq. (6.5) and (6.6), or where the phase vanishes, Eq. (6.7)."""
    n = 1 << (t.size - 1).bit_length()
    padded = np.zeros((n, weighted.shape[1]), np.complex128)
    np.add.at(padded, t[:, 0].astype(int) % n, weighted)
    h = np.fft.fft(padded, axis=0)
    k, pixels = np.abs(h).argmax(axis=0), np.arange(weighted.shape[1])
    if not interpolated:
        return np.asarray(2.0 * pi / n * k)
    side = np.where(np.abs(h[(k + 1) % n, pixels]) > np.abs(h[k - 1, pixels]), 1, -1)
    here, there = h[k, pixels], h[(k + side) % n, pixels]
    # The phase falls by nearly pi a bin and vanishes at the peak; here it is within pi / 2 but for a jump.
    change = side * np.angle(there * here.conj())
    change = np.where(change < 0.0, -change, 2.0 * pi - change)
    phase = np.angle(here)
    phase = side * (phase - pi * np.rint(phase / pi))
    phase += np.where(phase < -0.25 * pi, pi, 0.0)
    return np.asarray(2.0 * pi / n * (k + side * np.clip(phase / change, -0.5, 1.0)))


def _sigma(signals: _Signals) -> Floats:
    """Return the standard deviation of omega of a return of amplitude 1 with a free phase.

    sqrt(variance / sum v (t - c)^2), c the mean of t; with a window what the windowed sums make of it.
    """
    t, v = signals.t[:, None], signals.search * signals.transfer
    centre = np.sum(v * t, axis=0) / _positive(v.sum(axis=0))
    lever = np.sum(v * t * (t - centre), axis=0)
    weight = np.where(signals.precision > 0.0, signals.search, 0.0) ** 2 / _positive(signals.precision)
    scatter = np.sum(weight * (t - centre) ** 2, axis=0)
    return np.asarray(np.sqrt(signals.variance * scatter) / _positive(np.abs(lever)))
