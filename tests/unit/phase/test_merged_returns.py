"""What ranging cannot see in a pixel: blurred fringes, and returns too close to be told apart."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.phase.fourier_domain_ranging import range_returns, score_threshold
from sms_jobs.metrology.phase.fringe_blur import blur_variance, transfer_of_sample
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.merged_returns import merged_sigma

FRINGES, STEPS = 32, 4
DENSITIES = tuple(range(FRINGES))
MEAN, NOISE = 2000.0, 20.0
CAMERA = GreyLevels(65535, 0.0, NOISE)


def frames(
    rng: np.random.Generator, returns: list[tuple[NDArray[np.float64], float]], variance: float = 0.0
) -> NDArray[np.uint16]:
    """Return noisy frames (4 s - 2, rows, columns) of returns of given omega and amplitude, blurred alike."""
    made = []
    for t in DENSITIES:
        for k in range(STEPS) if t else (0, STEPS // 2):
            fringes = [a * np.cos(omega * t + 2.0 * pi * k / STEPS) for omega, a in returns]
            made.append(MEAN + np.exp(-0.5 * variance * t * t) * np.sum(fringes, axis=0))
    levels = np.stack(made)
    return np.rint(levels + NOISE * rng.standard_normal(levels.shape)).astype(np.uint16)


@pytest.mark.parametrize("variance", [0.0, 1e-4, 6e-4])
def test_the_blur_is_found_in_single_returns_among_double_ones(
    rng: np.random.Generator, variance: float
) -> None:
    omega = rng.uniform(-3.0, 3.0, (8, 64))
    single = frames(rng, [(omega, 1000.0)], variance)
    double = frames(rng, [(omega, 700.0), (omega + rng.uniform(0.2, 1.0, omega.shape), 300.0)], variance)
    found = blur_variance(np.concatenate([single, double], axis=1), DENSITIES, STEPS, CAMERA)
    # p of one pixel has the standard deviation 2 (sigma_z / B) sqrt(45 / 4) / s^2.5 = 1.6e-5; the median of
    # 512 pixels is 18 times better. Half of the noise of a p of 0 is cut off.
    assert found == pytest.approx(variance, abs=5e-6)


def test_where_nothing_is_lit_once_the_power_of_all_pixels_tells(rng: np.random.Generator) -> None:
    omega = rng.uniform(-3.0, 3.0, (8, 64))
    variance = 6e-4
    double = frames(rng, [(omega, 700.0), (omega + rng.uniform(0.5, 2.5, omega.shape), 300.0)], variance)
    assert blur_variance(double, DENSITIES, STEPS, CAMERA) is None
    found = transfer_of_sample(double, DENSITIES, STEPS, CAMERA)
    # At the highest density a quarter of the modulation is lost; what the returns beat in the first few
    # densities is a few percent.
    assert found[-1] == pytest.approx(np.exp(-0.5 * variance * 31**2), abs=0.06)
    dark = rng.poisson(40.0, double.shape).astype(np.uint16)
    np.testing.assert_array_equal(transfer_of_sample(dark, DENSITIES, STEPS, CAMERA), 1.0)
    single = frames(rng, [(omega, 1000.0)], variance)
    found = transfer_of_sample(single, DENSITIES, STEPS, CAMERA)
    # p is good to 1e-6 (see above).
    np.testing.assert_allclose(found, np.exp(-0.5 * variance * np.square(DENSITIES)), atol=2e-3)


def test_a_merged_return_is_off_by_what_is_stated(rng: np.random.Generator) -> None:
    one_bin = 2.0 * pi / FRINGES
    threshold = score_threshold(1e-4, FRINGES)
    chosen, others = 800.0, 200.0
    omega = rng.uniform(-2.0, 2.0, (40, 100))
    apart = rng.uniform(0.0, 0.4 * one_bin, omega.shape)
    made = frames(rng, [(omega, chosen), (omega + apart, others)])
    found = range_returns(made, DENSITIES, STEPS, CAMERA, returns=2)
    merged = found.count == 1
    assert 0.2 < merged.mean() < 0.9
    off = (found.omega[0] - omega)[merged]
    ones = np.ones(omega.shape, np.float32)
    none = np.full(omega.shape, np.nan, np.float32)
    stated = merged_sigma(
        [np.float32(NOISE) * ones, np.float32(NOISE) * ones],
        np.stack([found.amplitude[0], np.float32(chosen) * ones]),
        [found.amplitude, np.stack([np.float32(chosen) * ones, np.float32(others) * ones])],
        threshold=threshold,
        densities=FRINGES,
        steps=STEPS,
    )
    assert (stated[1] == 0.0).all()  # the orientation that tells them apart
    assert (stated[0][found.count == 2] == 0.0).all()
    # The limit of what is told apart is no sharp one, and the noise adds 0.1 of this: to a quarter.
    assert np.sqrt(np.mean(off**2)) == pytest.approx(float(np.median(stated[0][merged])), rel=0.25)
    nothing = merged_sigma([ones], none[None], [none[None]], threshold=threshold, densities=32, steps=4)
    assert (nothing == 0.0).all()
