"""What texture does to the phases of two cameras: found in those of each, corrected, and the rest stated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.phase.seen_texture import SeenTexture
from sms_jobs.metrology.phase.texture_error import UNKNOWN
from sms_jobs.metrology.phase.texture_of_two import Spots, estimate_rough, estimate_spot

SIDE, FINER = 96, 8
SIGMA = 2e-5


def seen(blur_px: float, rng: np.random.Generator, contrast: float) -> tuple[Floats, SeenTexture]:
    """Return phases of a bent surface as a camera with a spot sees them, with its texture."""
    size = SIDE * FINER
    y, x = np.mgrid[:size, :size] / FINER
    omega = np.stack([0.011 * x + 0.002 * y + 2e-5 * x * x, -0.002 * x + 0.012 * y + 1e-5 * x * y])
    speckles = ndimage.gaussian_filter(rng.normal(size=(size, size)), 2.0 * FINER)
    bright = 1.0 + contrast * np.tanh(2.0 * speckles / speckles.std())

    def through(image: Floats) -> Floats:
        blurred = ndimage.gaussian_filter(image, blur_px * FINER, mode="nearest")
        return np.asarray(blurred.reshape(SIDE, FINER, SIDE, FINER).mean(axis=(1, 3)))

    light = through(bright)
    phases = np.stack([through(bright * one) / light for one in omega])
    phases += SIGMA * rng.normal(size=phases.shape)
    everywhere = np.ones((SIDE, SIDE), dtype=bool)
    return phases, SeenTexture.of(light[None].astype(np.float32), everywhere, everywhere, 1)


@pytest.mark.parametrize("blur_px", [0.4, 0.7])
def test_a_spot_is_found_in_the_phases_of_its_camera(blur_px: float, rng: np.random.Generator) -> None:
    phases, texture = seen(blur_px, rng, 0.6)
    variance, sigma, shift = estimate_spot(phases, np.full(phases.shape, SIGMA, np.float32), texture)
    true = blur_px**2 + 1.0 / 12.0
    # Its standard deviation is that of the model; three of these.
    assert sigma == pytest.approx(0.02, rel=0.2)
    assert abs(variance - true) < 3.0 * sigma
    # Without the texture's error phases lie on their parabolas: five times nearer than with it.
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5 - 0.5 / FINER
    exact = np.stack([0.011 * x + 0.002 * y + 2e-5 * x * x, -0.002 * x + 0.012 * y + 1e-5 * x * y])
    inner = (slice(None), slice(6, -6), slice(6, -6))
    before, after = ((one - exact)[inner].std() for one in (phases, phases - variance * shift[0]))
    assert after < 0.2 * before


def test_without_a_texture_nothing_is_known_but_what_was_before(rng: np.random.Generator) -> None:
    phases, texture = seen(0.5, rng, 0.0)
    variance, sigma, _ = estimate_spot(phases, np.full(phases.shape, SIGMA, np.float32), texture)
    assert variance == pytest.approx(UNKNOWN.variance)
    assert sigma == pytest.approx(UNKNOWN.variance_sigma, rel=0.01)


def test_what_pixels_hide_is_found_in_gaps(rng: np.random.Generator) -> None:
    rough = rng.uniform(0.0, 1.0, 20_000)
    gap = np.hypot(0.02, 0.06 * rough) * rng.normal(size=rough.size)
    noise, textured = np.full(rough.size, 0.02), rng.normal(size=rough.size)
    # Squares of 20,000 values of which the roughest count: known to a few per cent.
    assert estimate_rough(gap, noise, textured, rough) == pytest.approx(0.06, rel=0.1)
    plain = estimate_rough(gap[:50], noise[:50], 0.0 * rough[:50], rough[:50])
    assert plain == pytest.approx(UNKNOWN.rough_px)


def test_what_is_left_of_both_adds_up_and_their_mean_is_better_known() -> None:
    spots = Spots(np.array([0.2, 0.4]), np.array([0.03, 0.04]), 0.1)
    shifts = np.array([[2.0]]), np.array([[1.0]])
    spreads = np.zeros((1, 1), np.float32), np.zeros((1, 1), np.float32)
    np.testing.assert_allclose(spots.left(shifts, spreads), np.hypot(0.06, 0.04), rtol=1e-6)
    assert spots.mean.variance == pytest.approx(0.3)
    assert spots.mean.variance_sigma == pytest.approx(0.5 * np.hypot(0.03, 0.04))
    assert spots.largest(1) == pytest.approx(0.44)
