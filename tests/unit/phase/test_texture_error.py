"""The texture's error: predicted by the modulation's gradient, measured by the ray gaps it opens."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.phase.texture_error import (
    TYPICAL,
    estimate_blur,
    log_gradient,
    texture_shift,
    textured_interior,
)

Floats = NDArray[np.float64]

SPOT = 0.7  # standard deviation in px
SHAPE = (60, 80)
SLOPES = np.array([[5e-3, 1e-3], [-2e-3, 6e-3]])  # of omega along x and y, rad/px


def seen_through_a_spot(rng: np.random.Generator, fine: int = 8) -> tuple[Floats, Floats, Floats]:
    """Return brightness, omega as measured (2, ...) and omega at the pixel centres, for a random texture.

    Computed on a grid `fine` times finer: the mean of R and of R omega over a Gaussian spot.
    """
    rows, columns = SHAPE[0] * fine, SHAPE[1] * fine
    texture = np.exp(ndimage.gaussian_filter(rng.normal(size=(rows, columns)), 2.0 * fine) * 2.0 * fine * 2.0)
    y, x = (np.indices((rows, columns)) - (fine // 2)) / fine
    middle = slice(fine // 2, None, fine)
    brightness = ndimage.gaussian_filter(texture, SPOT * fine)[middle, middle]
    omega = np.tensordot(SLOPES, np.stack([x, y]), axes=1)
    smeared = np.stack([ndimage.gaussian_filter(texture * o, SPOT * fine)[middle, middle] for o in omega])
    return brightness, smeared / brightness, omega[:, middle, middle]


def inside(values: Floats) -> Floats:
    return values[..., 6:-6, 6:-6]


def test_the_shift_of_a_textured_surface_is_taken_away(rng: np.random.Generator) -> None:
    brightness, measured, exact = seen_through_a_spot(rng)
    valid = np.ones(SHAPE, dtype=bool)
    shift = texture_shift(measured, valid, log_gradient(brightness))
    before = inside(measured - exact)
    after = inside(measured - SPOT**2 * shift - exact)
    assert np.abs(before).max() > 5e-4
    # What is left comes from taking grad(omega) of the measured omega, itself disturbed by the texture:
    # s^2 times the second derivative of ln B, here about 0.1, of the correction.
    assert np.sqrt(np.mean(after**2)) < 0.2 * np.sqrt(np.mean(before**2))


def test_the_log_gradient_of_an_exponential_is_its_exponent() -> None:
    y, x = np.indices(SHAPE).astype(float)
    found = log_gradient(np.exp(0.11 * x - 0.07 * y))
    # A cubic spline's derivative at the knots is good to h^4 f^(5) / 180, 1e-6 relative; the mirrored
    # border's part of it falls by 0.27 a pixel, to 1e-7 after twelve.
    np.testing.assert_allclose(inside(inside(found[0])), 0.11, rtol=1e-5)
    np.testing.assert_allclose(inside(inside(found[1])), -0.07, rtol=1e-5)


def test_darkness_has_no_gradient() -> None:
    np.testing.assert_array_equal(log_gradient(np.zeros((8, 9))), 0.0)


def test_slopes_do_not_reach_across_edges_or_gaps() -> None:
    x = np.arange(40.0)
    omega = np.where(x < 20, 0.01 * x, 0.01 * x + 0.5) * np.ones((2, 12, 1))
    valid = np.ones((12, 40), dtype=bool)
    valid[:, 10] = False
    gradient = np.zeros((2, 12, 40))
    gradient[0] = 1.0
    shift = texture_shift(omega, valid, gradient)
    assert (shift[:, ~valid] == 0.0).all()
    np.testing.assert_allclose(shift[:, valid], 0.01, atol=1e-12)  # rounding


def test_the_blur_is_found_from_gaps(rng: np.random.Generator) -> None:
    n, sigma, variance = 4000, 0.02, 0.34
    change = rng.normal(scale=0.3, size=n)
    gap = rng.normal(scale=sigma, size=n) - variance * change
    gap[:100] += 5.0  # pixels that see two surfaces
    found = estimate_blur(gap, np.full(n, sigma), change)
    # sigma / (0.3 sqrt(n)) = 1e-3; four times that.
    assert found.variance == pytest.approx(variance, abs=4e-3)
    # Chi-square of 4000 degrees of freedom scatters by 2 %: of noise sigma against 0.34 x 0.3 mm.
    assert found.unexplained < 0.05


def test_what_the_correction_leaves_is_measured_too(rng: np.random.Generator) -> None:
    n, sigma, variance, part = 20_000, 0.005, 0.34, 0.25
    change = rng.normal(scale=0.3, size=n)
    gap = rng.normal(scale=sigma, size=n) - variance * change * (1.0 + part * rng.normal(size=n))
    found = estimate_blur(gap, np.full(n, sigma), change)
    assert found.variance == pytest.approx(variance, rel=0.05)  # part / sqrt(n), and the trimming's share
    assert found.unexplained == pytest.approx(part, rel=0.25)  # trimming at 4 cuts the tails of a product


def test_a_gap_from_calibration_is_not_the_textures(rng: np.random.Generator) -> None:
    n, sigma, variance = 20_000, 0.02, 0.34
    change = rng.normal(scale=0.3, size=n)
    gap = 0.08 + rng.normal(scale=sigma, size=n) - variance * change
    found = estimate_blur(gap, np.full(n, sigma), change)
    # 0.08 / (0.3 sqrt(n)) = 2e-3, as the offset is noise to the fit; four times that.
    assert found.variance == pytest.approx(variance, abs=8e-3)
    # The excess, 0.0064 mm^2, scatters by 0.0033 / sqrt(n / 5) = 5e-5 against 0.01 mm^2: a part of 0.07.
    assert found.unexplained < 0.15


def test_without_texture_the_lens_is_taken_to_be_in_focus(rng: np.random.Generator) -> None:
    gap = rng.normal(size=500)
    nothing = np.zeros(0)
    assert estimate_blur(gap, np.ones(500), np.zeros(500)) == TYPICAL
    assert estimate_blur(nothing, nothing, nothing) == TYPICAL


def test_edges_and_plain_surface_do_not_tell_the_blur() -> None:
    valid = np.ones((9, 11), dtype=bool)
    valid[4, 8] = False
    gradient = np.full((2, 9, 11), 0.3)
    gradient[:, 7, 2] = 0.01  # no texture
    inside = textured_interior(valid, gradient, margin=1)
    expected = np.zeros_like(valid)
    expected[1:-1, 1:-1] = True
    expected[3:6, 7:10] = False
    expected[7, 2] = False
    np.testing.assert_array_equal(inside, expected)
