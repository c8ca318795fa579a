"""Simulated returns and the bounds they are compared with."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from sms_jobs.bench.fringes.returns import (
    FULL_SCALE,
    found_near,
    pairs,
    patterns,
    rms,
    simulate,
    single_bound,
    stronger_bound,
    wrapped,
)


@pytest.mark.parametrize(("bins", "ratio"), [(0.3, 6.7), (0.5, 2.5), (0.7, 1.4), (1.0, 1.05), (1.5, 1.02)])
def test_the_bound_of_two_returns_grows_as_they_come_close(bins: float, ratio: float) -> None:
    found = stronger_bound(np.array([bins]), 64, 50.0)[0] / single_bound(64, 50.0)
    # The figures are known to two digits.
    assert found == pytest.approx(ratio, rel=0.02)


def test_the_bound_is_that_of_linearised_least_squares(rng: np.random.Generator) -> None:
    # The scatter of (J^T J)^-1 J^T n over white noise n is the bound, whatever the weaker amplitude.
    apart = 0.6
    omega, amplitude, noise, t = np.array([0.5, 0.5 + apart * pi / 16]), [1000.0, 400.0], 15.0, np.arange(32)
    turned = np.exp(1j * omega[:, None] * t)
    slopes = np.concatenate([1j * t * np.array(amplitude)[:, None] * turned, turned])
    jacobian = np.concatenate([slopes.real, slopes.imag], axis=1).T
    drawn = rng.standard_normal((64, 20_000)) * noise * np.sqrt(2.0 / 4.0)
    scatter = np.std(np.linalg.lstsq(jacobian, drawn, rcond=None)[0][0])
    # 20 000 samples give a standard deviation to 0.5 %; four of those.
    assert scatter == pytest.approx(stronger_bound(np.array([apart]), 32, 1000.0 / noise)[0], rel=0.02)


def test_bounds_between_the_computed_ones_are_exact_enough(rng: np.random.Generator) -> None:
    apart = rng.uniform(0.3, 1.0, 50)
    one_by_one = [stronger_bound(np.array([bins]), 64, 50.0)[0] for bins in apart]
    np.testing.assert_allclose(stronger_bound(apart, 64, 50.0), one_by_one, rtol=1e-3)


@pytest.mark.parametrize("law", ["normal", "uniform"])
def test_frames_are_the_thesis_equation_plus_noise(law: str, rng: np.random.Generator) -> None:
    omega = rng.uniform(-pi, pi, (2, 4096))
    signals = simulate(omega, (1.0, 0.5), 8, 50.0, rng, law=law)  # type: ignore[arg-type]
    assert signals.frames.shape == (4 * 8 - 2, 8, 512)
    assert signals.frames.max() < FULL_SCALE
    angle = np.array([omega * t + pi / 2.0 * k for t, k in patterns(8)])
    light = np.einsum("r,frp->fp", signals.amplitude, np.cos(angle))
    noise = signals.frames.reshape(30, -1) - light
    # 120 000 samples give the deviation to 0.2 %, the mean to 0.06; rounding adds 1e-4 of the variance.
    assert np.std(noise) == pytest.approx(20.0, rel=0.01)
    assert np.mean(noise) == pytest.approx(1500.0 + 8.0 * 20.0, abs=0.3)


def test_pairs_are_as_far_apart_as_asked(rng: np.random.Generator) -> None:
    omega = pairs(1024, (0.5, 1.0), 64, rng)
    apart = simulate(omega, (1.0, 0.5), 64, 50.0, rng).apart_bins
    assert 0.5 <= apart.min() < apart.max() <= 1.0
    assert np.abs(omega).max() <= pi


def test_ranging_finds_what_was_simulated(rng: np.random.Generator) -> None:
    omega = pairs(1024, (2.0, 3.0), 16, rng)
    signals = simulate(omega, (1.0, 0.5), 16, 50.0, rng)
    error, good = found_near(signals, signals.ranged())
    assert good.all()
    least = stronger_bound(signals.apart_bins, 16, 50.0)
    # 1024 pixels give the ratio to 2.2 %; five of those.
    assert rms(error[0] / least) == pytest.approx(1.0, abs=0.12)
    single = simulate(omega[:1], (1.0,), 16, 50.0, rng)
    error = wrapped(single.unwrapped().omega.ravel() - single.omega[0])
    assert rms(error) == pytest.approx(single_bound(16, 50.0), rel=0.12)


def test_a_return_that_serves_two_is_not_success(rng: np.random.Generator) -> None:
    omega = np.full((2, 512), 0.5)
    omega[1] += 0.05 * 2.0 * pi / 16
    signals = simulate(omega, (1.0, 0.5), 16, 20.0, rng)
    _, good = found_near(signals, signals.ranged(returns=1))
    assert not good.any()
