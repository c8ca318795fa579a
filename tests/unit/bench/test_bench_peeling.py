"""Ranging as in the thesis: its bound, its peaks, and several returns one after the other."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import pytest

from sms_jobs.bench.fringes.return_bounds import omega_bounds
from sms_jobs.bench.fringes.returns import FULL_SCALE, pairs, rms, simulate, wrapped

FRINGES = 64
SIGNAL_TO_NOISE = 50.0


@pytest.mark.parametrize("interpolated", [False, True])
def test_the_free_phase_costs_a_factor_of_two(interpolated: bool, rng: np.random.Generator) -> None:
    signals = simulate(rng.uniform(-pi, pi, (1, 3072)), (1.0,), FRINGES, SIGNAL_TO_NOISE, rng)
    found = signals.peeled(interpolated=interpolated)
    t = np.arange(FRINGES)
    bound = omega_bounds(np.zeros(1), signals.amplitude, t, signals.noise, known_origin=False)[0]
    assert bound == pytest.approx(sqrt(6.0) / (SIGNAL_TO_NOISE * FRINGES**1.5), rel=0.01)
    # 3072 samples: the rms scatters by 1.3 %; three of those.
    assert rms(wrapped(found.omega[0].ravel() - signals.omega[0])) / bound == pytest.approx(1.0, abs=0.04)
    np.testing.assert_allclose(found.omega_sigma[0], bound, rtol=0.02)  # B scatters by 0.25 %
    np.testing.assert_allclose(found.amplitude[0], signals.amplitude[0], rtol=0.02)


def test_the_interpolated_start_is_the_peak_without_noise(rng: np.random.Generator) -> None:
    # Table 6 of the thesis: kappa = 3.3 of s = 64, its noise 0.01 of the mean intensity (uniform).
    omega = np.full((1, 1024), 3.3 * 2.0 * pi / FRINGES)
    signals = simulate(omega, (1.0,), FRINGES, 1.0 / 0.015, rng, law="uniform")
    t = np.arange(FRINGES)
    bound = omega_bounds(np.zeros(1), signals.amplitude, t, signals.noise, known_origin=False)[0]
    error = wrapped(signals.peeled().omega[0].ravel() - omega[0])
    # 1024 samples: 2.2 % a deviation; four of those.
    assert rms(error) / bound == pytest.approx(1.0, abs=0.09)


@pytest.mark.parametrize("window", ["none", "hann", "hamming"])
@pytest.mark.parametrize("interpolated", [False, True])
def test_peeling_finds_separate_returns_with_any_window(
    interpolated: bool, window: str, rng: np.random.Generator
) -> None:
    signals = simulate(pairs(512, (8.3, 8.3), FRINGES, rng), (1.0, 0.5), FRINGES, SIGNAL_TO_NOISE, rng)
    coarse, fine = (
        wrapped(
            signals.peeled(interpolated=interpolated, window=window, refinements=n).omega.reshape(2, -1)
            - signals.omega
        )
        for n in (0, 3)
    )
    # A bin is 0.098 rad; leakage of the other return moves a peak by some hundredths of a bin.
    one_bin = 2.0 * pi / FRINGES
    np.testing.assert_allclose(fine[0], 0.0, atol=0.1 * one_bin)
    np.testing.assert_allclose(fine[1], 0.0, atol=0.2 * one_bin)
    assert rms(fine[0]) <= 1.05 * rms(coarse[0])


def test_noise_and_full_scale_are_no_returns(rng: np.random.Generator) -> None:
    signals = simulate(rng.uniform(-pi, pi, (1, 512)), (1.0,), FRINGES, SIGNAL_TO_NOISE, rng)
    assert np.isfinite(signals.peeled(2).omega[1]).sum() <= 3  # 1e-4 of the pixels
    signals.frames[:] = FULL_SCALE
    assert np.isnan(signals.peeled().omega).all()


def test_a_saturated_density_is_left_out(rng: np.random.Generator) -> None:
    signals = simulate(rng.uniform(-pi, pi, (1, 512)), (1.0,), FRINGES, SIGNAL_TO_NOISE, rng)
    signals.frames[101] = FULL_SCALE
    error = wrapped(signals.peeled().omega[0].ravel() - signals.omega[0])
    # One density of 64 is worth little; five deviations of the largest of 512.
    assert np.abs(error).max() < 5.0 * sqrt(6.0) / (SIGNAL_TO_NOISE * FRINGES**1.5)
