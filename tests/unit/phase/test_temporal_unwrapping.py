"""Temporal unwrapping: equal to a slow reference, unbiased, and as noisy as its bound."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.metrology.phase.unwrapping_plan import unwrapping_plan

Floats = NDArray[np.float64]

REVERSE_EXPONENTIAL = (32, 31, 30, 28, 24, 16)
FORWARD_EXPONENTIAL = (1, 2, 4, 8, 16, 32)
LINEAR = tuple(range(1, 17))
SEQUENCES = [
    REVERSE_EXPONENTIAL,
    FORWARD_EXPONENTIAL,
    LINEAR,
    (1, 16),  # two frequencies
    (1, 6, 36),  # three frequencies
    (11, 10),  # beat
    (3, 5),  # neither differs by one from the other
    (1,),
]
FULL_SCALE = 4095
SHAPE = (30, 70)  # two blocks of rows, one of them short


def frames_of(
    omega: Floats,
    densities: tuple[int, ...],
    steps: int = 4,
    level: float = 1500.0,
    modulation: float | Floats = 1000.0,
) -> Floats:
    """Return exact frames (densities * steps, rows, columns); `modulation` may be one a density."""
    amplitudes = np.broadcast_to(modulation, (len(densities),))
    return np.array(
        [
            level + b * np.cos(omega * t + 2.0 * pi * k / steps)
            for t, b in zip(densities, amplitudes, strict=True)
            for k in range(steps)
        ]
    )


def recorded(frames: Floats, noise: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    noisy = frames + rng.normal(scale=noise, size=frames.shape)
    return np.clip(np.rint(noisy), 0, FULL_SCALE).astype(np.uint16)


def solve(
    frames: NDArray[np.uint16],
    densities: tuple[int, ...],
    steps: int = 4,
    noise: float = 0.0,
    gain: float = 0.0,
    threads: int = 1,
) -> PhaseGradient:
    return unwrap(
        frames, densities, steps, full_scale=FULL_SCALE, gain=gain, read_noise=noise, threads=threads
    )


def wrapped(angle: Floats) -> Floats:
    return angle - 2.0 * pi * np.rint(angle / (2.0 * pi))


def reference(
    frames: Floats, densities: tuple[int, ...], steps: int, truth: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return omega, modulation and phase error the slow way; fringe orders come from the truth."""
    k = np.arange(steps)[:, None, None]
    stack = np.asarray(frames, dtype=float).reshape(len(densities), steps, *truth.shape)
    z = 2.0 / steps * np.sum(stack * np.exp(-2j * pi * k / steps), axis=1)
    t = np.array(densities, dtype=float)[:, None, None]
    phase = truth * t + np.angle(z * np.exp(-1j * truth * t))
    weight = np.abs(z) ** 2
    omega = np.sum(weight * t * phase, axis=0) / np.sum(weight * t * t, axis=0)
    n = len(densities)
    spread = np.sum(weight * (phase - omega * t) ** 2, axis=0) / np.sum(weight, axis=0)
    return (
        omega,
        np.sqrt(np.mean(weight, axis=0)),
        np.sqrt(spread * n / (n - 1)) if n > 1 else spread * np.nan,
    )


@pytest.fixture
def omega(rng: np.random.Generator) -> Floats:
    """Phase gradients as far out as the last pixel of a projector, (rows, columns) in rad."""
    return rng.uniform(-pi + 0.01, pi - 0.01, size=SHAPE)


@pytest.mark.parametrize("steps", [3, 4, 7])
@pytest.mark.parametrize("densities", SEQUENCES, ids=str)
def test_the_kernel_is_the_slow_reference(
    densities: tuple[int, ...], steps: int, omega: Floats, rng: np.random.Generator
) -> None:
    frames = recorded(frames_of(omega, densities, steps), 8.0, rng)
    found = solve(frames, densities, steps, noise=8.0)
    expected, modulation, error = reference(frames, densities, steps, omega)
    # The arctangent is good to 1e-10 rad.
    np.testing.assert_allclose(wrapped(found.omega - expected), 0.0, atol=1e-9)
    np.testing.assert_allclose(found.modulation, modulation, rtol=1e-6)  # single precision
    np.testing.assert_allclose(found.phase_error, error, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(found.mean_intensity, np.mean(frames, axis=0), rtol=1e-6)
    assert not found.ambiguous.any()
    assert not found.saturated.any()
    assert (found.fitted == len(densities)).all()


@pytest.mark.parametrize("densities", SEQUENCES[:5], ids=str)
@pytest.mark.parametrize("steps", [3, 4])
def test_omega_scatters_as_predicted_and_has_no_bias(
    densities: tuple[int, ...], steps: int, omega: Floats, rng: np.random.Generator
) -> None:
    noise, modulation = 20.0, 1000.0  # B / sigma = 50
    found = solve(recorded(frames_of(omega, densities, steps), noise, rng), densities, steps, noise=noise)
    bound = noise / (modulation * sqrt(steps / 2.0 * sum(t * t for t in densities)))
    error = wrapped(found.omega - omega)
    n = omega.size
    # 2100 samples: the rms scatters by 1 / sqrt(2 n) = 1.5 %, the mean by sigma / sqrt(n); 4 of each.
    assert np.sqrt(np.mean(error**2)) == pytest.approx(bound, rel=4.0 / sqrt(2.0 * n))
    assert abs(np.mean(error)) < 4.0 * bound / sqrt(n)
    # B is estimated from the same noise: 2 sigma^2 / (q B^2) relative.
    assert np.median(found.omega_sigma) == pytest.approx(bound, rel=1e-3)
    if len(densities) > 2:
        residual = sqrt(2.0 / steps) * noise / modulation
        ratio = np.mean((found.phase_error / residual) ** 2)
        # Chi-square of n (densities - 1) degrees of freedom.
        assert ratio == pytest.approx(1.0, abs=4.0 * sqrt(2.0 / (n * (len(densities) - 1))))


def test_shot_noise_is_predicted_from_the_mean_level(omega: Floats, rng: np.random.Generator) -> None:
    gain, read = 0.2, 3.0
    exact = frames_of(omega, REVERSE_EXPONENTIAL)
    frames = recorded(exact, 0.0, rng) + np.rint(
        rng.normal(size=exact.shape) * np.sqrt(read**2 + gain * exact)
    ).astype(np.int64)
    found = solve(frames.astype(np.uint16), REVERSE_EXPONENTIAL, noise=read, gain=gain)
    z = wrapped(found.omega - omega) / found.omega_sigma
    # 2100 samples, as above; rounding adds 1/12 to a variance of 300.
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.065)


def test_weights_pay_where_dense_fringes_are_blurred(omega: Floats, rng: np.random.Generator) -> None:
    densities, noise = (64, 63, 62, 60, 56, 48, 32), 20.0
    blurred = 1000.0 * np.exp(-((np.array(densities) / 40.0) ** 2))
    found = solve(
        recorded(frames_of(omega, densities, modulation=blurred), noise, rng), densities, noise=noise
    )
    t = np.array(densities, dtype=float)
    sigma = np.sqrt(0.5) * noise / blurred
    weighted = 1.0 / np.sqrt(np.sum((t / sigma) ** 2))
    equal = np.sqrt(np.sum((t * sigma) ** 2)) / np.sum(t * t)
    scatter = np.sqrt(np.mean(wrapped(found.omega - omega) ** 2))
    # B / sigma is 4 at the densest fringes: second-order terms of 2 (sigma / B)^2 there, 5 % with scatter.
    assert scatter == pytest.approx(weighted, rel=0.1)
    assert scatter < 0.7 * equal
    assert np.median(found.omega_sigma) == pytest.approx(scatter, rel=0.1)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_offset_and_amplitude_do_not_matter(dtype: type, omega: Floats) -> None:
    def omega_of(level: float, modulation: float) -> Floats:
        frames = np.rint(frames_of(omega, REVERSE_EXPONENTIAL, 4, level, modulation)).astype(dtype)
        return unwrap(frames, REVERSE_EXPONENTIAL, 4, full_scale=255, gain=0.0, read_noise=0.3).omega

    # Rounding to grey levels is noise of 0.29 levels: 5 sigma of it, over 40 levels of modulation.
    tolerance = 5.0 * 0.29 / (40.0 * sqrt(2.0 * sum(t * t for t in REVERSE_EXPONENTIAL)))
    np.testing.assert_allclose(omega_of(60.0, 40.0), omega, atol=tolerance)
    np.testing.assert_allclose(omega_of(130.0, 100.0), omega, atol=tolerance)


def test_a_saturated_density_is_left_out_of_the_fit(rng: np.random.Generator) -> None:
    # Glare lifts the dark level until the bright half of the fringes is cut off in some densities.
    omega = rng.uniform(-3.0, 3.0, size=SHAPE)
    frames = recorded(frames_of(omega, REVERSE_EXPONENTIAL, level=3300.0), 5.0, rng)
    cut = (frames.reshape(6, 4, *SHAPE) >= FULL_SCALE).any(axis=1).sum(axis=0)
    found = solve(frames, REVERSE_EXPONENTIAL, noise=5.0)
    np.testing.assert_array_equal(found.fitted, 6 - cut)
    np.testing.assert_array_equal(found.saturated, 6 - cut < 2)
    assert np.isnan(found.omega[found.saturated]).all()
    rescued = (cut > 0) & ~found.saturated & ~found.ambiguous
    assert rescued.mean() > 0.2
    z = (found.omega - omega)[rescued] / found.omega_sigma[rescued]
    # Unbiased by the clipping: some 400 samples and more scatter by 3.5 % at most; four times that.
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.15)


def test_contradicting_fringe_orders_are_flagged(omega: Floats, rng: np.random.Generator) -> None:
    frames = recorded(frames_of(omega, FORWARD_EXPONENTIAL), 8.0, rng)
    other = recorded(frames_of(wrapped(omega + 0.6), FORWARD_EXPONENTIAL), 8.0, rng)
    frames[8:12] = other[8:12]  # four fringes as if of another place: 4 x 0.6 rad off
    assert solve(frames, FORWARD_EXPONENTIAL, noise=8.0).ambiguous.mean() > 0.9


def test_noise_that_drowns_the_fringe_order_is_flagged(omega: Floats, rng: np.random.Generator) -> None:
    densities = (1, 200)  # the order of 200 fringes from one: 200 x 0.014 rad of error at B / sigma = 50
    found = solve(recorded(frames_of(omega, densities), 20.0, rng), densities, noise=20.0)
    assert found.ambiguous.all()


def test_threads_change_nothing(omega: Floats, rng: np.random.Generator) -> None:
    frames = recorded(frames_of(omega, REVERSE_EXPONENTIAL), 20.0, rng)
    one = solve(frames, REVERSE_EXPONENTIAL, noise=20.0)
    two = solve(frames, REVERSE_EXPONENTIAL, noise=20.0, threads=2)
    for name in ("omega", "omega_sigma", "modulation", "phase_error", "mean_intensity", "ambiguous"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_the_reverse_exponential_sequence_climbs_by_differences() -> None:
    plan = unwrapping_plan(REVERSE_EXPONENTIAL)
    # s - t = 1, 2, 4, 8, 16, as in the thesis's Fig. 10.
    assert list(plan.density[:5]) == [1.0, 2.0, 4.0, 8.0, 16.0]
    # Each step is phi_s - 2 phi_t + phi_t' of three phases: sqrt(1 + 4 + 1).
    assert plan.amplification == pytest.approx(sqrt(6.0))


@pytest.mark.parametrize(
    ("densities", "message"),
    [((16, 32), "share the factor 16"), ((6, 10, 15), "differ by one fringe"), ((2,), "share the factor 2")],
)
def test_an_ambiguous_list_is_refused(densities: tuple[int, ...], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        unwrapping_plan(densities)


def test_a_wrong_number_of_frames_is_refused() -> None:
    with pytest.raises(InvalidInput, match="make 24 frames, not 23"):
        solve(np.zeros((23, 4, 4), np.uint16), REVERSE_EXPONENTIAL)
