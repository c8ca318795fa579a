"""What must not change the returns of a pixel: scale, offset, order, threads, how density 0 is recorded."""

from __future__ import annotations

from math import pi

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sms_jobs.metrology.phase.fourier_domain_ranging import Returns, range_returns
from sms_jobs.metrology.phase.grey_levels import GreyLevels

Floats = NDArray[np.float64]

ROUNDING = 0.3  # standard deviation of rounding to whole grey levels


def frames_of(
    omegas: list[Floats],
    amplitudes: list[float],
    densities: tuple[int, ...],
    steps: int,
    level: float = 30_000.0,
    *,
    all_of_density_0: bool = False,
) -> NDArray[np.uint16]:
    frames = []
    for t in densities:
        for k in (0, steps // 2) if t == 0 and not all_of_density_0 else range(steps):
            waves = [
                a * np.cos(w * t + 2.0 * pi * k / steps) for a, w in zip(amplitudes, omegas, strict=True)
            ]
            frames.append(level + sum(waves))
    return np.rint(frames).astype(np.uint16)


def ranged(
    frames: NDArray[np.uint16], densities: tuple[int, ...], steps: int, returns: int, threads: int = 1
) -> Returns:
    return range_returns(
        frames,
        densities,
        steps,
        GreyLevels(65_535, 0.0, ROUNDING),
        returns=returns,
        threads=threads,
    )


def assert_measured(found: Returns, omegas: list[Floats]) -> None:
    for i, omega in enumerate(omegas):
        error = found.omega[i] - omega
        error -= 2.0 * pi * np.rint(error / (2.0 * pi))
        # Rounding of fringes is not quite random: seven deviations, and single precision of the sums.
        assert (np.abs(error) < 7.0 * found.omega_sigma[i] + 1e-6).all()


sequences = st.tuples(st.integers(8, 40), st.integers(0, 1)).map(lambda p: tuple(range(p[1], p[0] + p[1])))


@settings(max_examples=25, deadline=None)
@given(sequences, st.integers(3, 7), st.floats(500.0, 9000.0), st.integers(0, 2**32 - 1))
def test_any_steps_scale_and_offset_give_the_same_returns(
    densities: tuple[int, ...], steps: int, strong: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    one = rng.uniform(-pi, pi, size=(2, 12))
    two = one + rng.uniform(1.5, 3.0, one.shape) * 2.0 * pi / len(densities)
    amplitudes = [strong, 0.6 * strong]
    frames = frames_of([one, two], amplitudes, densities, steps)
    assert_measured(ranged(frames, densities, steps, 2), [one, two])
    assert_measured(ranged(frames - np.uint16(1000), densities, steps, 2), [one, two])
    swapped = frames_of([two, one], amplitudes[::-1], densities, steps)
    np.testing.assert_array_equal(
        ranged(swapped, densities, steps, 2).omega, ranged(frames, densities, steps, 2).omega
    )


@settings(max_examples=10, deadline=None)
@given(st.integers(3, 7), st.integers(0, 2**32 - 1))
def test_threads_columns_and_the_frames_of_density_0_do_not_matter(steps: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    densities = tuple(range(16))
    omega = rng.uniform(-pi, pi, size=(9, 70))  # two chunks of pixels, one of them short
    frames = frames_of([omega], [8000.0], densities, steps)
    one, two = ranged(frames, densities, steps, 2), ranged(frames, densities, steps, 2, threads=2)
    part = ranged(frames[:, 3:4, 5:], densities, steps, 2)
    for name in ("omega", "omega_sigma", "amplitude", "width", "residual", "count"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_allclose(part.omega[0], one.omega[0, 3:4, 5:], rtol=0.0, atol=1e-6)
    whole = frames_of([omega], [8000.0], densities, steps, all_of_density_0=True)
    assert_measured(one, [omega])
    assert_measured(ranged(whole, densities, steps, 1), [omega])
