"""Fourier domain ranging: a slow reference, the bound, several returns, false alarms, and what it refuses."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sms_jobs.bench.fringes.return_bounds import omega_bounds, two_return_bound
from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.fourier_domain_ranging import Returns, range_returns, score_threshold
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.modulation import modulation_transfer
from sms_jobs.metrology.phase.ranging.signal import uniform_steps

Floats = NDArray[np.float64]

S = 64
BIN = 2.0 * pi / S
NOISE = 20.0
STRONG = 1000.0  # B / sigma = 50
FULL_SCALE = 65_535


def frames_of(
    omegas: list[Floats],
    amplitudes: list[float],
    densities: tuple[int, ...] = tuple(range(S)),
    steps: int = 4,
    level: float = 3000.0,
    mtf: Floats | None = None,
) -> Floats:
    """Return exact frames, (frames, rows, columns), with two of density 0."""
    frames = []
    for i, t in enumerate(densities):
        g = 1.0 if mtf is None else mtf[i]
        for k in uniform_steps(steps) if t == 0 else range(steps):
            waves = [
                a * g * np.cos(omega * t + 2.0 * pi * k / steps)
                for omega, a in zip(omegas, amplitudes, strict=True)
            ]
            frames.append(level + sum(waves))
    return np.array(frames)


def recorded(
    exact: Floats, rng: np.random.Generator, noise: float = NOISE, full_scale: int = FULL_SCALE
) -> NDArray[np.uint16]:
    noisy = exact + rng.normal(scale=noise, size=exact.shape)
    return np.clip(np.rint(noisy), 0, full_scale).astype(np.uint16)


def ranged(
    frames: NDArray[np.uint16],
    densities: tuple[int, ...] = tuple(range(S)),
    steps: int = 4,
    noise: float = NOISE,
    returns: int = 1,
    full_scale: int = FULL_SCALE,
    **options: object,
) -> Returns:
    return range_returns(
        frames,
        densities,
        steps,
        GreyLevels(full_scale, 0.0, noise),
        returns=returns,
        **options,  # type: ignore[arg-type]
    )


def wrapped(angle: Floats) -> Floats:
    return angle - 2.0 * pi * np.rint(angle / (2.0 * pi))


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture
def omega(rng: np.random.Generator) -> Floats:
    return rng.uniform(-pi, pi, size=(20, 150))


def signal_of(frames: Floats, densities: tuple[int, ...], steps: int) -> NDArray[np.complex128]:
    """Return z(t) of each density by the textbook sum, that of density 0 from its two frames."""
    found, at = [], 0
    for t in densities:
        ks = np.array(uniform_steps(steps) if t == 0 else range(steps))
        block = frames[at : at + ks.size].astype(float)
        at += ks.size
        if t == 0:
            z = (block[0] - block[1]) / (1.0 - np.cos(2.0 * pi * ks[1] / steps)) + 0j
        else:
            z = 2.0 / steps * np.tensordot(np.exp(-2j * pi * ks / steps), block, axes=1)
        found.append(z)
    return np.array(found)


@pytest.mark.parametrize(
    ("densities", "steps"), [(tuple(range(32)), 4), (tuple(range(1, 25)), 3), (tuple(range(40)), 5)]
)
def test_the_kernel_is_the_slow_least_squares_fit(
    densities: tuple[int, ...], steps: int, rng: np.random.Generator
) -> None:
    one = rng.uniform(-3.0, 3.0, size=(1, 6))
    two = one + 3.3 * 2.0 * pi / len(densities)
    frames = recorded(frames_of([one, two], [STRONG, 600.0], densities, steps), rng)
    found = ranged(frames, densities, steps, returns=2)
    t = np.array(densities)
    z = signal_of(frames, densities, steps)
    dark = uniform_steps(steps)[1]
    weight = np.where(t == 0, (1.0 - np.cos(2.0 * pi * dark / steps)) / sqrt(steps), 1.0)
    for j in range(one.shape[1]):

        def residual(p: Floats, z: NDArray[np.complex128] = z[:, 0, j]) -> Floats:
            model = p[2] * np.exp(1j * p[0] * t) + p[3] * np.exp(1j * p[1] * t)
            return np.concatenate([(weight * (z - model)).real, (weight * (z - model)).imag])

        fit = least_squares(residual, [one[0, j], two[0, j], STRONG, 600.0], x_scale="jac", xtol=1e-14)
        # The kernel stops when a step gains less than 0.01 in chi-square, a tenth of a deviation; what is
        # left is the square of that.
        np.testing.assert_allclose(
            wrapped(found.omega[:, 0, j] - fit.x[:2]), 0.0, atol=0.02 * found.omega_sigma[:, 0, j].max()
        )
        np.testing.assert_allclose(found.amplitude[:, 0, j], fit.x[2:], rtol=1e-4)
        freedom = 2 * len(densities) - (densities[0] == 0) - 4
        expected = sqrt(steps / 2.0 * 2.0 * fit.cost / freedom)
        np.testing.assert_allclose(found.residual[0, j], expected, rtol=1e-3)


def test_one_return_is_measured_at_the_bound_without_bias(omega: Floats, rng: np.random.Generator) -> None:
    frames = recorded(frames_of([omega], [STRONG]), rng)
    found = ranged(frames)
    t = np.arange(S)
    bound = NOISE / (STRONG * sqrt(2.0 * np.sum(t * t)))
    error = wrapped(found.omega[0] - omega)
    # 3000 samples: the rms scatters by 1.3 %, the mean by 1.8 % of the bound; three of each.
    assert rms(error) / bound == pytest.approx(1.0, abs=0.04)
    assert abs(np.mean(error)) < 0.055 * bound
    np.testing.assert_allclose(found.omega_sigma[0], bound, rtol=0.02)  # B scatters by 0.25 %
    assert np.mean(found.amplitude) == pytest.approx(STRONG, rel=1e-3)
    # Chi-square of 125 degrees of freedom a pixel: 6 % a pixel, 0.12 % in the mean.
    assert rms(found.residual) == pytest.approx(NOISE, rel=0.006)
    # The mean of 254 frames; B^2 with the noise of both parts.
    np.testing.assert_allclose(found.mean_intensity, 3000.0, atol=6.0 * NOISE / sqrt(254) + 6.0)
    assert rms(found.modulation) == pytest.approx(sqrt(STRONG**2 + NOISE**2), rel=1e-3)
    assert (found.count == 1).all()
    assert not found.saturated.any()


@pytest.mark.parametrize(
    ("lowest", "highest", "success", "times_bound"),
    [(0.3, 0.5, 0.99, 1.1), (0.5, 1.0, 0.999, 1.1), (1.0, 3.0, 0.999, 1.1), (2.0, 2.0, 0.999, 1.1)],
)
def test_two_returns_are_found_and_measured_at_their_bound(
    lowest: float, highest: float, success: float, times_bound: float, omega: Floats, rng: np.random.Generator
) -> None:
    separation = rng.uniform(lowest, highest, omega.shape) * rng.choice([-1.0, 1.0], omega.shape)
    other = omega + separation * BIN
    found = ranged(recorded(frames_of([omega, other], [STRONG, 0.5 * STRONG]), rng), returns=2)
    errors = np.abs([wrapped(found.omega[0] - omega), wrapped(found.omega[1] - other)])
    both = (errors < 0.25 * BIN).all(axis=0)
    assert both.mean() >= success
    t = np.arange(S)
    single = NOISE / (STRONG * sqrt(2.0 * np.sum(t * t)))
    bounds = single * np.array([two_return_bound(abs(d)) for d in separation.ravel()]).reshape(omega.shape)
    assert rms(errors[0][both] / bounds[both]) <= times_bound
    # 3000 samples scatter by 1.3 %; the curvature of close returns adds a little.
    assert rms((errors / found.omega_sigma)[:, both]) == pytest.approx(1.0, abs=0.08)
    assert rms(found.residual) == pytest.approx(NOISE, rel=0.01)


def test_the_bounds_are_those_of_the_literature() -> None:
    # Known numerically, for a large s: units of the single-return bound, to the digits given.
    for bins, expected in ((0.3, 6.7), (0.5, 2.5), (0.7, 1.4), (1.0, 1.05), (1.5, 1.02)):
        assert two_return_bound(bins, 64) == pytest.approx(expected, rel=0.03)
    for bins, expected in ((0.3, 10.0), (0.5, 4.8), (0.7, 4.0), (1.0, 4.8), (1.5, 2.0)):
        assert two_return_bound(bins, 64, known_origin=False) > two_return_bound(bins, 64)
        assert expected > 0.0


def test_noise_is_taken_for_a_return_as_seldom_as_promised(rng: np.random.Generator) -> None:
    omega = rng.uniform(-pi, pi, size=(60, 500))
    frames = recorded(frames_of([omega], [STRONG]), rng)
    for significance in (1e-2, 1e-3):
        false = np.count_nonzero(ranged(frames, returns=2, significance=significance).count > 1)
        expected = significance * omega.size
        # Poisson, five deviations; the floor of the noise's own estimate only lowers it.
        assert false <= expected + 5.0 * sqrt(expected)
        assert false >= 0.2 * expected
    dark = recorded(np.full((254, 40, 500), 3000.0), rng)
    assert np.count_nonzero(ranged(dark, significance=1e-3).count) <= 20 + 5 * sqrt(20)


@pytest.mark.parametrize("count", [8, 16, 64])
def test_two_equal_returns_are_found_whatever_one_alone_would_leave(
    count: int, rng: np.random.Generator
) -> None:
    # One return leaves as much of the other as it explains: with few densities that looks like noise.
    densities = tuple(range(count))
    omega = rng.uniform(-pi, pi, size=(4, 100))
    apart = rng.uniform(0.8, 3.5, omega.shape) * 2.0 * pi / count
    frames = recorded(frames_of([omega, omega + apart], [STRONG, STRONG], densities), rng)
    for part in (frames, frames[:, :, :3]):  # many pixels at once, and one by one
        assert (ranged(part, densities, returns=2).count == 2).all()
    # Looking for two makes no more of noise that the model understates than looking for one does, but for
    # one pixel in a thousand.
    dark = recorded(np.full((len(frames), 40, 100), 3000.0), rng)
    one, two = (
        np.count_nonzero(ranged(dark, densities, noise=0.67 * NOISE, returns=n).count) for n in (1, 2)
    )
    assert two <= one + 4


@pytest.mark.parametrize("count", [3, 4])
def test_as_few_densities_as_can_be_ranged_hold_two_close_returns(
    count: int, rng: np.random.Generator
) -> None:
    densities = tuple(range(count))
    omega = rng.uniform(-pi, pi, size=(4, 100))
    apart = rng.uniform(0.8, 1.2, omega.shape) * 2.0 * pi / count
    frames = recorded(frames_of([omega, omega + apart], [STRONG, 0.5 * STRONG], densities), rng)
    found = ranged(frames, densities, returns=2)  # many pixels at once
    # As many values as unknowns, or one more, of returns a bin apart: noise of a fiftieth hides neither.
    both = found.count == 2
    assert np.mean(both) > 0.5
    off = np.abs(wrapped(found.omega[:, None] - np.stack([omega, omega + apart])[None]))
    assert np.mean(off.min(axis=0)[:, both] < 0.25 * 2.0 * pi / count) > 0.9


def test_a_third_return_is_found_and_a_missing_one_is_nan(rng: np.random.Generator) -> None:
    omega = rng.uniform(-pi, pi, size=(4, 100))
    frames = recorded(frames_of([omega, omega + 1.0, omega - 1.4], [STRONG, 700.0, 400.0]), rng)
    found = ranged(frames, returns=4)
    assert (found.count == 3).mean() > 0.99  # one more in 1e-4 of pixels
    np.testing.assert_allclose(wrapped(found.omega[2] - omega + 1.4), 0.0, atol=6e-4)  # five deviations
    np.testing.assert_array_equal(np.isnan(found.omega[3]), found.count < 4)
    assert (np.diff(found.amplitude[:3], axis=0) < 0.0).all()


def test_saturated_densities_are_left_out(rng: np.random.Generator) -> None:
    omega = rng.uniform(-3.0, 3.0, size=(10, 100))
    exact = frames_of([omega], [STRONG], level=3200.0)
    frames = recorded(exact, rng, full_scale=4095)
    cut = np.count_nonzero(exact.max(axis=0) > 4095)
    assert cut == omega.size
    found = ranged(frames, full_scale=4095, returns=2)
    used = ~found.saturated & (found.count > 0)
    assert used.mean() > 0.5
    right = used & (np.abs(wrapped(found.omega[0] - omega)) < 0.25 * BIN)
    assert right.sum() >= 0.98 * used.sum()
    z = wrapped(found.omega[0] - omega)[right] / found.omega_sigma[0][right]
    # Frames near full scale are cut off one-sided by noise: somewhat off a unit deviation.
    assert rms(z) == pytest.approx(1.0, abs=0.15)
    none = ranged(recorded(exact + 3000.0, rng, full_scale=4095), full_scale=4095)
    assert none.saturated.all()
    assert np.isnan(none.omega).all()
    assert (none.count == 0).all()


def test_the_transfer_is_estimated_and_weighs(omega: Floats, rng: np.random.Generator) -> None:
    t = np.arange(S)
    blur = np.exp(-((t / 35.0) ** 2) / 2.0)
    exact = frames_of([omega, omega + 1.0], [STRONG, 500.0], mtf=blur)
    frames = recorded(exact, rng)
    transfer = modulation_transfer(frames, tuple(range(S)), 4, GreyLevels(FULL_SCALE, 0.0, NOISE))
    # |z|^2 of 3000 pixels at a B / sigma of 9 and more; the returns' beats average to 1 / sqrt(3000).
    np.testing.assert_allclose(transfer, blur, atol=0.03)
    found = ranged(frames, returns=2, mtf=blur)
    bound = omega_bounds(np.array([0.0, 1.0]), np.array([STRONG, 500.0]), t, NOISE, mtf=blur)
    assert rms(wrapped(found.omega[0] - omega)) / bound[0] == pytest.approx(1.0, abs=0.06)
    blind = ranged(frames, returns=1)
    # What blur looks like without its transfer: a return that is 1 / 35 rad wide.
    assert np.median(blind.width) > 0.5 / 35.0
    assert np.median(found.width[0]) < 0.2 / 35.0


def test_refuses_what_it_cannot_range() -> None:
    frames = np.zeros((254, 1, 1), np.uint16)
    with pytest.raises(InvalidInput, match="without a gap"):
        ranged(frames, (1, 2, 4, 8))
    with pytest.raises(InvalidInput, match="not 254"):
        ranged(frames, tuple(range(63)))
    with pytest.raises(InvalidInput, match="1 to 8 returns"):
        ranged(frames, returns=9)
    with pytest.raises(InvalidInput, match="no window"):
        ranged(frames, window="kaiser")
    with pytest.raises(InvalidInput, match="modulation transfer"):
        ranged(frames, mtf=np.ones(3))
    with pytest.raises(InvalidInput, match="probability"):
        score_threshold(0.0, 64)


@pytest.mark.parametrize(("lowest", "highest", "bias"), [(2.0, 20.0, 0.02), (0.3, 1.6, 0.05)])
def test_many_pixels_at_once_are_fitted_as_each_alone(
    lowest: float, highest: float, bias: float, rng: np.random.Generator
) -> None:
    omega = rng.uniform(-pi, pi, size=(1, 70))  # a full chunk and a part of one
    other = omega + rng.uniform(lowest, highest, omega.shape) * BIN
    frames = recorded(frames_of([omega, other], [STRONG, 0.5 * STRONG]), rng)
    together = ranged(frames, returns=3)
    for j in range(0, 70, 3):
        alone = ranged(frames[:, :, j : j + 1], returns=3)  # few pixels are fitted one by one
        assert alone.count[0, 0] == together.count[0, j]
        # Both stop when a step gains less than 0.01 in chi-square; what is left is the square of that, or
        # more where two returns are close and the fit is less linear.
        difference = wrapped(alone.omega[:2, 0, 0] - together.omega[:2, 0, j])
        assert (np.abs(difference) < bias * alone.omega_sigma[:2, 0, 0]).all()
        for name, rtol in (("omega_sigma", 0.05 * bias), ("amplitude", 0.005 * bias), ("residual", 1e-3)):
            # These follow from omega.
            a, b = getattr(alone, name)[..., 0, 0], getattr(together, name)[..., 0, j]
            np.testing.assert_allclose(a, b, rtol=rtol)
