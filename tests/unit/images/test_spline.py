"""Splines are those of SciPy, whichever loop computes a point."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.images.spline import PADDING, spline_coefficients, spline_gradient, spline_values

Order = Literal[3, 5]
orders = pytest.mark.parametrize("order", [3, 5])


def values_at(image: np.ndarray, x: np.ndarray, y: np.ndarray, order: Order = 5) -> np.ndarray:
    coefficients = spline_coefficients(image, order)
    column, row = (np.floor(v).astype(np.int64) for v in (x, y))
    first = (row + PADDING - 2) * coefficients.shape[1] + column + PADDING - 2
    found = np.empty(len(x))
    spline_values(coefficients, order, len(x), first, x - column, y - row, found)
    return found


def expected_at(image: np.ndarray, x: np.ndarray, y: np.ndarray, order: Order) -> np.ndarray:
    return ndimage.map_coordinates(image, [y, x], order=order, mode="mirror")


@orders
def test_the_spline_is_scipys(rng: np.random.Generator, order: Order) -> None:
    image = rng.uniform(0.0, 4095.0, (40, 50))
    x, y = rng.uniform(2.0, 37.0, (2, 300))
    # Rounding: 36 products of numbers near 10^4.
    np.testing.assert_allclose(values_at(image, x, y, order), expected_at(image, x, y, order), atol=1e-9)


@orders
@pytest.mark.parametrize("slope", [0.0, 0.01, 0.04, -0.3])
def test_runs_of_neighbours_and_scattered_points_agree(
    rng: np.random.Generator, slope: float, order: Order
) -> None:
    """Rows that are hardly turned go through a loop of their own, between others that do not."""
    image = rng.uniform(0.0, 4095.0, (60, 80))
    j, i = (v.ravel().astype(np.float64) for v in np.mgrid[0:20, 0:33])
    x, y = 25.3 + i - slope * j, 20.6 + j + slope * i
    np.testing.assert_allclose(values_at(image, x, y, order), expected_at(image, x, y, order), atol=1e-9)


@orders
def test_the_spline_goes_over_the_border_by_reflection(rng: np.random.Generator, order: Order) -> None:
    image = rng.uniform(0.0, 4095.0, (30, 30))
    x = np.array([-4.5, -1.2, 33.9])
    y = np.array([3.3, -4.1, 31.0])
    np.testing.assert_allclose(values_at(image, x, y, order), expected_at(image, x, y, order), atol=1e-9)
    assert abs(x).max() - 29.0 < PADDING - 3


@orders
def test_slopes_are_finite_differences_of_values(rng: np.random.Generator, order: Order) -> None:
    image = ndimage.gaussian_filter(rng.uniform(0.0, 4095.0, (40, 40)), 1.0)
    along_x, along_y = spline_gradient(spline_coefficients(image, order), order)
    x, y = (v.ravel().astype(np.float64) for v in np.meshgrid(np.arange(5, 35), np.arange(5, 35)))
    h = 1e-3
    dx = (values_at(image, x + h, y, order) - values_at(image, x - h, y, order)) / (2.0 * h)
    dy = (values_at(image, x, y + h, order) - values_at(image, x, y - h, order)) / (2.0 * h)
    inner = np.s_[5:35, 5:35]
    # h^2 / 6 times a third derivative below 10^4 (where a cubic's jumps, the mean), and rounding 10^-9 / h.
    np.testing.assert_allclose(along_x[inner].ravel(), dx, atol=5e-3)
    np.testing.assert_allclose(along_y[inner].ravel(), dy, atol=5e-3)
