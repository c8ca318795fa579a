"""Phase gradients as pixels of the projector."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.projector_pixels import projector_pixels
from sms_jobs.metrology.phase.patterns import direction, span_px

COLUMNS, ROWS = 1024, 768


def phases(pixels: np.ndarray, orientations: tuple[float, ...]) -> np.ndarray:
    """Return omega of projector pixels (2, ...) as docs/conventions.md defines it."""
    centred = pixels - np.array([0.5 * (COLUMNS - 1), 0.5 * (ROWS - 1)]).reshape(2, 1, 1)
    return np.stack(
        [
            2.0 * pi * np.tensordot(direction(angle), centred, axes=1) / span_px(COLUMNS, ROWS, angle)
            for angle in orientations
        ]
    )


@pytest.mark.parametrize("orientations", [(0.0, pi / 2), (pi / 4, -pi / 4), (0.0, pi / 3, 2 * pi / 3)])
def test_phases_lead_back_to_the_pixel(orientations: tuple[float, ...], rng: np.random.Generator) -> None:
    pixels = rng.uniform(0.0, 700.0, (2, 5, 6))
    omega = phases(pixels, orientations)
    found, _ = projector_pixels(omega, np.zeros(omega.shape, np.float32), orientations, COLUMNS, ROWS)
    # Rounding of a product of four numbers below 1e3.
    np.testing.assert_allclose(found, pixels, atol=1e-11)


def test_the_stated_deviation_is_that_of_the_scatter(rng: np.random.Generator) -> None:
    orientations = (0.0, pi / 3, 2 * pi / 3)
    sigma = np.array([1e-3, 2e-3, 5e-4], np.float32)[:, None, None] * np.ones((3, 100, 200), np.float32)
    noisy = sigma * rng.standard_normal(sigma.shape)
    found, stated = projector_pixels(noisy, sigma, orientations, COLUMNS, ROWS)
    scatter = found.std(axis=(1, 2))
    # 20,000 samples tell a standard deviation to 0.5 %; four times that.
    np.testing.assert_allclose(scatter, stated[:, 0, 0], rtol=0.02)


def test_parallel_fringes_are_refused() -> None:
    omega = np.zeros((2, 1, 1))
    with pytest.raises(InvalidInput, match="parallel"):
        projector_pixels(omega, omega.astype(np.float32), (0.0, 0.0), COLUMNS, ROWS)
