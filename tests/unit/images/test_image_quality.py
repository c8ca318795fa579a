"""What an image tells of its texture before anybody matches it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.images.image_quality import BLOCK_PX, ImageQuality, image_quality

FULL_SCALE, GAIN, READ_NOISE = 4095, 0.4, 2.0
SIDE = 12 * BLOCK_PX


def speckle(rng: np.random.Generator, low: float, high: float) -> NDArray[np.float64]:
    """Return squares of 4 px that are dark or bright."""
    return np.kron(rng.choice([low, high], (SIDE // 4, SIDE // 4)), np.ones((4, 4)))


def taken(rng: np.random.Generator, level: NDArray[np.float64]) -> NDArray[np.uint16]:
    noisy = level + rng.normal(0.0, np.sqrt(READ_NOISE**2 + GAIN * level))
    return np.clip(np.rint(noisy), 0, FULL_SCALE).astype(np.uint16)


def judged(image: NDArray[np.uint16], areas: bool = True) -> ImageQuality:
    return image_quality(image, FULL_SCALE, GAIN, READ_NOISE, areas=areas)


def test_contrast_is_that_of_the_texture_without_noise(rng: np.random.Generator) -> None:
    found = judged(taken(rng, speckle(rng, 1000.0, 1400.0)))
    assert found.lit_fraction == 1.0
    assert found.saturated_fraction == 0.0
    # 16 squares a block, of which the median block has 7 to 9 bright ones: 198 to 200; its variance is known
    # to sqrt(2 / 256) of that of the noise.
    assert FULL_SCALE * found.contrast == pytest.approx(199.0, abs=3.0)
    assert found.contrast_to_noise == pytest.approx(199.0 / np.sqrt(4.0 + 0.4 * 1200.0), rel=0.05)
    assert FULL_SCALE * found.level == pytest.approx(1400.0 + 2.05 * 23.7, abs=10.0)


def test_noise_is_no_texture(rng: np.random.Generator) -> None:
    for level in (0.0, 50.0, 2000.0):
        assert judged(taken(rng, np.full((SIDE, SIDE), level))).lit_fraction == 0.0
    # Four standard deviations of the noise are not enough, six are.
    for sigmas, lit in ((4.0, 0.0), (6.5, 1.0)):
        half = sigmas * np.sqrt(4.0 + 0.4 * 1000.0)
        found = judged(taken(rng, speckle(rng, 1000.0 - half, 1000.0 + half)))
        assert found.lit_fraction == pytest.approx(lit, abs=0.1)


def test_an_outline_is_no_texture_unless_it_is_asked_for(rng: np.random.Generator) -> None:
    y, x = np.mgrid[:SIDE, :SIDE]
    disc = taken(rng, np.where(np.hypot(x - 90.0, y - 95.0) < 60.0, 2500.0, 100.0))
    assert judged(disc).lit_fraction == 0.0
    assert 0.1 < judged(disc, areas=False).lit_fraction < 0.4


def test_a_specimen_that_fills_a_part_is_found(rng: np.random.Generator) -> None:
    level = np.full((SIDE, SIDE), 200.0)
    level[: SIDE // 2, : SIDE // 2] = speckle(rng, 300.0, 1500.0)[: SIDE // 2, : SIDE // 2]
    assert judged(taken(rng, level)).lit_fraction == 0.25


def test_what_saturates_counts_as_lit(rng: np.random.Generator) -> None:
    level = speckle(rng, 300.0, 1500.0)
    level[: SIDE // 2] = 9000.0
    found = judged(taken(rng, level))
    assert (found.lit_fraction, found.saturated_fraction) == (1.0, 0.5)


def test_an_image_smaller_than_a_block_is_one(rng: np.random.Generator) -> None:
    assert judged(np.zeros((1, 1), np.uint16)) == ImageQuality(0.0, 0.0, 0.0, 0.0, 0.0)
    assert judged(taken(rng, speckle(rng, 300.0, 1500.0)[:9, :7])).lit_fraction == 1.0
