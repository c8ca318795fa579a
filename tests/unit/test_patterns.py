"""Laws of the fringe patterns: where omega lies, what it means, and what an imperfect projector does."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.metrology.geometry.camera import pixel_grid
from sms_jobs.metrology.geometry.projector_pixels import projector_pixels
from sms_jobs.metrology.phase.patterns import (
    fringe_harmonics,
    fringe_intensity,
    fringe_pattern,
    phase_gradient,
    span_px,
)

COLUMNS, ROWS = 40, 30


@pytest.mark.parametrize("orientation", [0.0, pi / 2, pi / 4, -pi / 4, 2.0])
def test_omega_is_symmetric_and_fills_the_circle(orientation: float) -> None:
    omega = phase_gradient(pixel_grid(ROWS, COLUMNS), COLUMNS, ROWS, orientation)
    # Turning the image by half a turn turns the sign; a few roundings of numbers up to pi.
    np.testing.assert_allclose(omega, -omega[::-1, ::-1], atol=1e-14)
    assert np.abs(omega).max() < pi
    corners = np.array([[-0.5, -0.5], [-0.5, ROWS - 0.5], [COLUMNS - 0.5, -0.5], [COLUMNS - 0.5, ROWS - 0.5]])
    assert np.max(phase_gradient(corners, COLUMNS, ROWS, orientation)) == pytest.approx(pi)


def test_omega_of_vertical_fringes_is_thesis_equation() -> None:
    # Eq. (1.16): phase 2 pi t (i - N/2) / N, here with pixel 0 at the centre of the first pixel.
    i = np.arange(COLUMNS)
    pixels = np.stack([i, np.full(COLUMNS, 7.0)], axis=-1)
    expected = 2.0 * pi * (i + 0.5 - COLUMNS / 2) / COLUMNS
    np.testing.assert_allclose(phase_gradient(pixels, COLUMNS, ROWS, 0.0), expected, atol=1e-15)


@given(
    st.floats(-0.5, COLUMNS - 0.5),
    st.floats(-0.5, ROWS - 0.5),
    st.sampled_from([(0.0, pi / 2), (pi / 4, -pi / 4)]),
)
def test_two_orientations_find_the_projector_pixel(
    x: float, y: float, orientations: tuple[float, float]
) -> None:
    pixel = np.array([x, y])
    omega = np.array([phase_gradient(pixel, COLUMNS, ROWS, o) for o in orientations])[:, None, None]
    found, _ = projector_pixels(omega, np.zeros((2, 1, 1), np.float32), orientations, COLUMNS, ROWS)
    # Some ten roundings of numbers up to 40 px.
    np.testing.assert_allclose(found[:, 0, 0], pixel, atol=1e-12)


@pytest.mark.parametrize("steps", [3, 4, 5])
def test_phase_steps_return_the_phase(steps: int, rng: np.random.Generator) -> None:
    omega = rng.uniform(-pi, pi, 100)
    frames = np.stack([fringe_intensity(omega, 3, k, steps, 0.7) for k in range(steps)])
    k = np.arange(steps)[:, None]
    phase = np.arctan2(
        -(frames * np.sin(2 * pi * k / steps)).sum(0), (frames * np.cos(2 * pi * k / steps)).sum(0)
    )
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(3j * omega), atol=1e-13)


def test_a_pattern_has_as_many_fringes_as_its_density() -> None:
    pattern = fringe_pattern(256, 8, 0.0, 5, 0, 4)
    assert pattern.shape == (8, 256)
    assert np.argmax(np.abs(np.fft.rfft(pattern[0] - pattern[0].mean()))) == 5
    assert pattern.min() >= 0.0
    assert pattern.max() <= 1.0


def test_harmonics_of_a_linear_projector_are_the_pattern() -> None:
    span = span_px(COLUMNS, ROWS, 0.0)
    np.testing.assert_allclose(fringe_harmonics(4, span, visibility=0.8), [0.5, 0.4], atol=1e-15)


def test_defocus_lowers_modulation_as_blurring_the_pattern_does() -> None:
    # A projector wide enough for 20 whole fringes of 20 px, blurred by brute force.
    span, density, sigma = 400, 20, 3.0
    x = np.arange(-40, 41)
    weights = np.exp(-0.5 * (x / sigma) ** 2)
    weights /= weights.sum()
    pattern = fringe_pattern(span, 1, 0.0, density, 0, 4)[0]
    blurred = sum(w * np.roll(pattern, k) for w, k in zip(weights, x, strict=True))
    c = fringe_harmonics(density, span, defocus_px=sigma)
    omega = phase_gradient(pixel_grid(1, span), span, 1, 0.0)[0]
    # Sampling a Gaussian of 3 px once a pixel is exact to exp(-2 pi^2 3^2), far below rounding.
    np.testing.assert_allclose(c[0] + c[1] * np.cos(density * omega), blurred, atol=1e-13)


@pytest.mark.parametrize("gamma", [0.6, 2.2])
def test_harmonics_add_up_to_the_projectors_response(gamma: float) -> None:
    phase = np.linspace(-pi, pi, 101)
    c = fringe_harmonics(4, 100.0, visibility=0.9, gamma=gamma)
    sent = 0.5 * (1.0 + 0.9 * np.cos(phase))
    # Each left-out harmonic is below 1e-7 and they fall off at least geometrically.
    series = np.polynomial.chebyshev.chebval(np.cos(phase), c)
    np.testing.assert_allclose(series, sent**gamma, atol=1e-6)
