"""Smoothing, and what it does to the noise that a match sees."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.images.smoothing import (
    LARGEST_SMOOTHING_PX,
    noise_after_smoothing,
    noise_in_windows,
    noise_of_differences,
    noise_of_pixels,
    smooth,
)

ONE = np.ones((40, 40), dtype=bool)


@pytest.mark.parametrize("sigma", [0.3, 0.6, LARGEST_SMOOTHING_PX])
def test_a_point_becomes_as_wide_as_was_asked(sigma: float) -> None:
    point = np.zeros((9, 9))
    point[4, 4] = 1.0
    spread = smooth(point, sigma)
    offsets = np.arange(9) - 4.0
    assert spread.sum() == pytest.approx(1.0, abs=1e-12)
    for axis in range(2):
        # Three weights s^2 / 2, 1 - s^2, s^2 / 2 have the variance s^2 exactly, but for rounding.
        assert offsets**2 @ spread.sum(axis=axis) == pytest.approx(sigma**2, abs=1e-12)


def test_no_smoothing_changes_nothing(rng: np.random.Generator) -> None:
    image = rng.normal(size=ONE.shape)
    np.testing.assert_array_equal(smooth(image, 0.0), image)
    assert noise_after_smoothing(image, ONE, 0.0) == 1.0


def test_the_scatter_of_a_shift_is_the_one_predicted(rng: np.random.Generator) -> None:
    # A shift by least squares from the slopes, d = sum D e / sum D^2, of 2000 images with white noise e.
    texture = smooth(rng.normal(size=ONE.shape), 0.7)
    slopes = np.gradient(texture, axis=1)
    found = [
        np.sum(slopes * smooth(rng.normal(size=ONE.shape), 0.6)) / np.sum(slopes**2) for _ in range(2000)
    ]
    sigma = np.sqrt(noise_after_smoothing(texture, ONE, 0.6) / np.sum(slopes**2))
    # Standard deviations from 2000 values scatter by 1 / sqrt(4000) = 1.6 %; the factor is the mean of both
    # axes, which differ by about as much in an image of 40 px.
    assert np.std(found) / sigma == pytest.approx(1.0, abs=0.07)


@pytest.mark.parametrize("part", [np.s_[:, :], np.s_[:7, 20:], np.s_[12:30, 9:26]])
def test_the_noise_in_a_part_is_told_by_its_own_slopes(
    part: tuple[slice, slice], rng: np.random.Generator
) -> None:
    texture, inside = smooth(rng.normal(size=ONE.shape), 0.7), np.zeros_like(ONE)
    inside[part] = rng.random(inside[part].shape) > 0.1
    slopes = [np.gradient(texture, axis=axis) for axis in range(2)]
    before = sum(np.sum(slope[inside] ** 2) for slope in slopes)
    after = sum(np.sum(smooth(slope, 0.6)[inside] ** 2) for slope in slopes)
    assert noise_after_smoothing(texture, inside, 0.6) == pytest.approx(after / before, rel=1e-12)


@pytest.mark.parametrize("sigma", [0.0, 0.6])
def test_the_noise_that_is_left_is_the_one_predicted(sigma: float, rng: np.random.Generator) -> None:
    """Of 400 x 400 pixels: a variance is known to 0.4 %, and to about twice that of neighbours alike."""
    noise = smooth(rng.normal(size=(400, 400)), sigma)
    assert noise.var() == pytest.approx(noise_of_pixels(sigma), rel=0.03)
    rows = np.diff(noise, 2, axis=0)
    assert np.diff(rows, 2, axis=1).var() == pytest.approx(noise_of_differences(sigma), rel=0.03)
    slope = smooth(rng.normal(size=(400, 400)), 0.7)
    radius = 3
    seen = ndimage.uniform_filter(slope * noise, 2 * radius + 1)[10:-10, 10:-10]
    square = ndimage.uniform_filter(slope**2, 2 * radius + 1)[10:-10, 10:-10]
    # 3200 windows that do not overlap: their variance is known to 2.5 %.
    found = seen.var() / square.mean() * (2 * radius + 1) ** 2
    assert found == pytest.approx(noise_in_windows(slope, sigma, radius), rel=0.1)
