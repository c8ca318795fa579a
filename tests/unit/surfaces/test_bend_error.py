"""The bend of a surface within a pixel: what it adds is known, and a step adds nothing that is not said."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.surfaces.bend_error import half_laplacian

Floats = NDArray[np.float64]

SPOT, SIZE, FINE = 0.6, 48, 8
SIGMA = 1e-4


def of_ball(radius: float) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return values of a ball before darkness through a spot, those in the middle, and where the ball is.

    They grow by 0.01 a pixel over the image and fall by that a pixel of depth.
    """
    y, x = (np.indices((SIZE * FINE, SIZE * FINE)) - FINE * SIZE // 2) / FINE
    square = radius**2 - x**2 - y**2
    inside = square > 0.0
    inverse = 0.01 * (x + np.sqrt(np.where(inside, square, 0.0)))
    middle = slice(0, None, FINE)
    spot = [ndimage.gaussian_filter(v, SPOT * FINE)[middle, middle] for v in (inverse * inside, inside * 1.0)]
    usable = ndimage.binary_erosion(inside[middle, middle], iterations=3)
    return np.where(usable, spot[0] / np.maximum(spot[1], 1e-9), np.nan), inverse[middle, middle], usable


def found(inverse: Floats, usable: NDArray[np.bool_], threads: int = 1) -> tuple[Floats, Floats]:
    return half_laplacian(np.where(usable, inverse, np.nan), np.full(inverse.shape, SIGMA), threads)


def test_a_ball_keeps_its_size() -> None:
    seen, exact, usable = of_ball(20.0)
    half, unsure = found(seen, usable)
    inner = ndimage.binary_erosion(usable, np.ones((5, 5)))
    before, after = (seen - exact)[inner], (seen - SPOT**2 * half - exact)[inner]
    # In the middle the Laplacian is 2 / R, and 0.36 / 20 px of 0.01: 1.8 deviations, at the limb many more.
    assert np.median(before) < -2.0 * SIGMA
    assert np.sqrt(np.mean(after**2)) < 0.15 * np.sqrt(np.mean(before**2))
    assert (np.abs(after) <= np.abs(before) + 1e-12).mean() > 0.99
    # What is left is the fourth derivative, and so is what the five pixels are off their parabola.
    left = np.abs(after) > 0.5 * SIGMA
    assert (np.abs(after)[left] < 2.0 * (SPOT**2 * unsure)[inner][left]).all()
    # The outermost two pixels have the bend of those inwards, and its size as deviation.
    outer = usable & ~inner
    beyond, stated = np.abs(seen - SPOT**2 * half - exact), np.hypot(SIGMA, SPOT**2 * unsure)
    assert np.abs(seen - exact)[outer].max() > 8.0 * SIGMA
    assert (beyond / stated)[outer].max() < 3.0


@pytest.mark.parametrize("height", [3.0, 10.0, 20.0, 40.0, 58.0, 100.0])
def test_a_step_bends_nothing_that_it_does_not_say(height: float) -> None:
    x = np.arange(40.0) * np.ones((12, 1))
    inverse = 0.01 * x + height * SIGMA * (x > 19.5)
    half, unsure = found(inverse, np.ones(x.shape, bool))
    assert (np.abs(half) <= 0.5 * 2.0 / 7.0 * height * SIGMA + 1e-12).all()
    # But for what noise explains of the distance from a parabola: 2 of its variances.
    assert (np.abs(half) <= np.hypot(unsure, 0.6 * SIGMA)).all()
    np.testing.assert_allclose(half[np.abs(x - 19.5) > 2.0], 0.0, atol=1e-12)
    # Beyond 20 deviations of the five from their parabola: a step of 59, or of 42 beside the middle.
    if height > 60.0:
        np.testing.assert_allclose(half, 0.0, atol=1e-12)


def test_noise_grows_by_what_is_said(rng: np.random.Generator) -> None:
    x = np.arange(200.0) * np.ones((200, 1))
    variance = 1.0 / 3.0
    noise = rng.normal(0.0, SIGMA, x.shape)
    half, unsure = found(0.01 * x + noise, np.ones(x.shape, bool))
    left = (noise - variance * half)[4:-4, 4:-4]
    stated = np.sqrt(SIGMA**2 + np.mean((variance * unsure[4:-4, 4:-4]) ** 2))
    # 37,000 pixels tell a deviation to 0.4 %; the bend's own is 0.24 of a pixel's, which it contains.
    assert np.std(left) == pytest.approx(1.02 * SIGMA, rel=0.015)
    assert stated == pytest.approx(np.std(left), rel=0.03)


def test_gaps_have_none_and_threads_change_nothing(rng: np.random.Generator) -> None:
    inverse = 0.01 * np.arange(40.0) ** 2 * np.ones((30, 1))
    usable = rng.random(inverse.shape) > 0.1
    half, unsure = found(inverse, usable)
    assert not half[~usable].any()
    assert not unsure[~usable].any()
    again = found(inverse, usable, threads=3)
    np.testing.assert_array_equal(half, again[0])
    np.testing.assert_array_equal(unsure, again[1])
    # A parabola has one second derivative, wherever the five pixels are known.
    np.testing.assert_allclose(half[half != 0.0], 0.01, rtol=1e-6)
    assert (half != 0.0).mean() > 0.4
