"""How wide the spot is that blurs a texture."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.images.sharpness import texture_width

EVERYWHERE = np.ones((256, 256), bool)


def texture(width: float, rng: np.random.Generator) -> np.ndarray:
    made = ndimage.gaussian_filter(rng.normal(size=EVERYWHERE.shape), width, mode="wrap")
    return np.asarray(2000.0 + 400.0 * made / made.std())


@pytest.mark.parametrize("width", [1.0, 1.5, 2.5])
def test_the_width_of_smoothed_noise_is_found(width: float, rng: np.random.Generator) -> None:
    # Of about 256^2 / (4 pi width^2) independent spots, 830 at the widest, the scatter is 4 % of a variance
    # and so 2 % of a width. The mean of a block of 16 px takes 4 pi width^2 / 256 of the variance with it,
    # which makes it look finer by half as much: 15 % at 2.5 px.
    found = texture_width(texture(width, rng), EVERYWHERE, 0.0, 0.0)
    assert found == pytest.approx(width, rel=0.04 + 0.025 * width**2)


def test_blur_adds_to_it_in_squares_and_noise_does_not(rng: np.random.Generator) -> None:
    sharp = texture(1.2, rng)
    blurred = ndimage.gaussian_filter(sharp, 1.0, mode="wrap")
    noise = 30.0
    widths = [
        texture_width(image + rng.normal(0.0, noise, sharp.shape), EVERYWHERE, noise**2, 0.0)
        for image in (sharp, blurred)
    ]
    # As above 2 % and 3 % of a width of 1.2 and 1.6 px, which is 0.08 px of the difference of their squares.
    assert np.sqrt(widths[1] ** 2 - widths[0] ** 2) == pytest.approx(1.0, abs=0.1)


def test_of_too_little_nothing_is_said(rng: np.random.Generator) -> None:
    sharp = texture(1.5, rng)
    assert np.isnan(texture_width(sharp, np.zeros_like(EVERYWHERE), 0.0, 0.0))
    assert np.isnan(texture_width(sharp[:12, :12], EVERYWHERE[:12, :12], 0.0, 0.0))
    noise = rng.normal(2000.0, 30.0, sharp.shape)
    assert np.isnan(texture_width(noise, EVERYWHERE, 900.0, 0.0))
