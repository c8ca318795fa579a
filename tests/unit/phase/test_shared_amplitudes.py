"""Close returns whose amplitudes another orientation tells: errors, sides, and what speaks against them."""

import numpy as np
import pytest

from sms_jobs.metrology.arrays import Complexes, Floats
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.harmonics import NO_GHOSTS, Ghosts
from sms_jobs.metrology.phase.ranging.shared_amplitudes import (
    CloseSignal,
    ToldApart,
    close_signal,
    tell_apart,
)

S, PIXELS, NOISE = 32, 2000, 2.0
T = np.arange(S, dtype=np.float64)
BIN = 2.0 * np.pi / S
TRANSFER = np.exp(-((T / 60.0) ** 2))
LIGHT = np.array([[200.0], [60.0]])
TOLD_SIGMA = np.array([[2.0], [2.0]])


def returns(bins: float) -> Floats:
    """Return the places (2, pixels) of two returns that are so far apart, the first anywhere."""
    first = np.random.default_rng(1).uniform(-2.0, 2.0, PIXELS)
    return np.stack([first, first + bins * BIN])


def signal_of(omega: Floats, ghosts: Ghosts = NO_GHOSTS) -> CloseSignal:
    """Return what a camera sees of two returns: variance 2 NOISE^2 / q in each part, q = 4."""
    random = np.random.default_rng(2)
    signal: Complexes = np.zeros((PIXELS, S), np.complex128)
    for places, light in zip(omega, LIGHT, strict=True):
        signal += light * TRANSFER * np.exp(1j * T * places[:, None])
        for n, ahead, back in zip(ghosts.orders, ghosts.forward, ghosts.backward, strict=True):
            signal += light * ahead * np.exp(1j * n * T * places[:, None])
            signal += light * back * np.exp(-1j * n * T * places[:, None])
    variance = NOISE**2 / 2.0
    signal += random.normal(0.0, np.sqrt(variance), (2, PIXELS, S)).T.swapaxes(0, 1) @ [1.0, 1j]
    return CloseSignal(signal, np.full((PIXELS, S), 1.0 / variance), T, TRANSFER, ghosts)


def told() -> Floats:
    """Return the amplitudes as another orientation tells them."""
    return np.asarray(LIGHT + TOLD_SIGMA * np.random.default_rng(3).normal(size=(2, PIXELS)))


def fitted(bins: float) -> tuple[Floats, ToldApart]:
    """Return errors (2, pixels) of two returns of which one was found, in rad, and the fit."""
    omega = returns(bins)
    middle = np.average(omega, axis=0, weights=LIGHT[:, 0])
    one = np.full(PIXELS, LIGHT.sum())
    found = np.stack([middle, np.full(PIXELS, np.nan), one, np.full(PIXELS, np.nan)])
    fit = tell_apart(signal_of(omega), found, told(), np.broadcast_to(TOLD_SIGMA, (2, PIXELS)))
    return fit.omega - omega, fit


def bounds(bins: float, amplitude_sigma: float) -> Floats:
    """Return the Cramer-Rao bounds (2,) of omega where amplitudes were observed with a deviation."""
    turns = TRANSFER * np.exp(1j * np.outer([0.0, bins * BIN], T))
    columns = np.concatenate([LIGHT * 1j * T * turns, turns])
    fisher = np.real(columns @ columns.conj().T) / (NOISE**2 / 2.0)
    fisher[[2, 3], [2, 3]] += 1.0 / amplitude_sigma**2
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(fisher)))[:2])


@pytest.mark.parametrize("bins", [0.3, 0.5, -0.5, 1.0])
def test_errors_are_the_bound_of_known_amplitudes(bins: float) -> None:
    """The rms of 2000 normal numbers is within 8 % of their deviation, at five deviations of its own."""
    error, fit = fitted(bins)
    assert not fit.ambiguous.any()
    assert not fit.against.any()
    rms = np.sqrt(np.mean(error**2, axis=1))
    assert rms == pytest.approx(bounds(bins, 2.0), rel=0.08)
    assert np.sqrt(np.mean((error / fit.omega_sigma) ** 2)) == pytest.approx(1.0, abs=0.08)


def test_amplitudes_are_worth_a_factor_where_returns_are_close() -> None:
    """Without them the bound of the stronger at 0.3 bins is more than twice what is reached with them."""
    error, _ = fitted(0.3)
    assert bounds(0.3, 1e9)[0] > 2.0 * np.sqrt(np.mean(error[0] ** 2))


def test_sides_that_cannot_be_told_are_named() -> None:
    """At a twelfth of a bin half the fits would be on the wrong side; whatever is not named is right."""
    error, fit = fitted(0.08)
    assert fit.ambiguous.mean() > 0.9
    told_apart = ~fit.ambiguous
    assert (np.abs(error[:, told_apart]) < 6.0 * fit.omega_sigma[:, told_apart]).all()


def test_a_return_of_its_own_amplitudes_speaks_against_others() -> None:
    """Amplitudes that are off by a third of the weaker are noticed where the signal tells them."""
    omega = returns(1.2)
    found = np.concatenate([omega, np.broadcast_to(LIGHT, (2, PIXELS))])
    wrong = LIGHT + np.array([[40.0], [-40.0]])
    fit = tell_apart(
        signal_of(omega), found, np.broadcast_to(wrong, (2, PIXELS)), np.broadcast_to(TOLD_SIGMA, (2, PIXELS))
    )
    assert fit.against.all()


def test_harmonics_are_a_part_of_each_return() -> None:
    """A ghost of a tenth at three times the phase moves nothing once it is in the model."""
    strength = np.full((1, S), 0.1, np.float32)
    ghosts = Ghosts(np.array([3.0]), np.zeros_like(strength), strength, 1)
    omega = returns(0.4)
    found = np.concatenate([omega, np.broadcast_to(LIGHT, (2, PIXELS))])
    fit = tell_apart(signal_of(omega, ghosts), found, told(), np.broadcast_to(TOLD_SIGMA, (2, PIXELS)))
    z = (fit.omega - omega) / fit.omega_sigma
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.08)


def test_a_signal_is_that_of_its_frames_without_saturated_densities() -> None:
    """Frames of four steps give back B exp(i omega t); one with a frame at full scale weighs nothing."""
    densities, omega, light = (1.0, 2.0, 3.0, 4.0), 0.7, 50.0
    phase = np.outer(densities, np.full(3, omega))[:, None] + (np.pi / 2.0 * np.arange(4))[:, None]
    frames = np.rint(100.0 + light * np.cos(phase)).reshape(16, 3).astype(np.uint16)
    frames[5, 2] = 255
    camera = GreyLevels(full_scale=255, gain=0.5, read_noise=2.0)
    close = close_signal(frames, densities, 4, camera, np.ones(4))
    expected = light * np.exp(1j * omega * np.array(densities))
    rounding = np.sqrt(0.5)  # half a level in either part
    assert close.signal[0] == pytest.approx(expected, abs=rounding)
    assert np.flatnonzero(close.weight[2] == 0.0).tolist() == [1]
    variance = 0.5 * (2.0**2 + 0.5 * frames[:, 0].mean())
    assert close.weight[0] == pytest.approx(1.0 / variance)
