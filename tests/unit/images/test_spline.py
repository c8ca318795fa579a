"""Splines are those of SciPy, whichever loop computes a point."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from scipy import ndimage
from scipy.interpolate import BSpline

from sms_jobs.metrology.images.spline import (
    KERNEL_CODE,
    PADDING,
    Interpolant,
    spline_coefficients,
    spline_gradient,
    spline_values,
)

Order = Literal["cubic", "quintic"]
orders = pytest.mark.parametrize("order", ["cubic", "quintic"])
DEGREE = {"cubic": 3, "quintic": 5}


def values_at(image: np.ndarray, x: np.ndarray, y: np.ndarray, order: Interpolant = "quintic") -> np.ndarray:
    coefficients = spline_coefficients(image, order)
    column, row = (np.floor(v).astype(np.int64) for v in (x, y))
    first = (row + PADDING - 2) * coefficients.shape[1] + column + PADDING - 2
    found = np.empty(len(x))
    spline_values(coefficients, KERNEL_CODE[order], len(x), first, x - column, y - row, found)
    return found


def expected_at(image: np.ndarray, x: np.ndarray, y: np.ndarray, order: Order) -> np.ndarray:
    return ndimage.map_coordinates(image, [y, x], order=DEGREE[order], mode="mirror")


@orders
def test_the_spline_is_scipys(rng: np.random.Generator, order: Order) -> None:
    image = rng.uniform(0.0, 4095.0, (40, 50))
    x, y = rng.uniform(2.0, 37.0, (2, 300))
    # Rounding: 36 products of numbers near 10^4.
    np.testing.assert_allclose(values_at(image, x, y, order), expected_at(image, x, y, order), atol=1e-9)


@orders
@pytest.mark.parametrize("shape", [(1, 30), (2, 9), (30, 3), (61, 17), (200, 333)])
def test_coefficients_are_scipys_whatever_the_size(
    rng: np.random.Generator, shape: tuple[int, int], order: Order
) -> None:
    image = rng.uniform(0.0, 4095.0, shape)
    inner = np.s_[PADDING:-PADDING, PADDING:-PADDING]
    expected = ndimage.spline_filter(image, order=DEGREE[order], mode="mirror")
    # Rounding: some tens of operations on numbers of 2 10^5, the filters gaining by 7.5 along either axis.
    np.testing.assert_allclose(spline_coefficients(image, order)[inner], expected, atol=5e-9)


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


@pytest.mark.parametrize("stretch", [-0.3, -0.17, -0.1, 0.06, 0.1, 0.17, 0.3, 0.6])
def test_stretched_neighbours_are_interpolated_as_others_are(
    rng: np.random.Generator, stretch: float
) -> None:
    """Their coefficients skip columns, or share them: up to two go through a loop of their own."""
    image = rng.uniform(0.0, 4095.0, (60, 100))
    j, i = (v.ravel().astype(np.float64) for v in np.mgrid[0:20, 0:33])
    x, y = 25.3 + (1.0 + stretch) * i + 0.02 * j, 20.6 + j + 0.03 * i
    # Rounding: 36 products of numbers near 10^4.
    np.testing.assert_allclose(values_at(image, x, y), expected_at(image, x, y, "quintic"), atol=1e-9)


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


def local_cubic(pixels: np.ndarray, a: float) -> float:
    """Return the cubic B-spline through four pixels whose outer coefficients repeat, past the second by a."""
    row = np.array([[5.0, 1.0, 0.0, 0.0], [1.0, 4.0, 1.0, 0.0], [0.0, 1.0, 4.0, 1.0], [0.0, 0.0, 1.0, 5.0]])
    coefficients = np.linalg.solve(row / 6.0, pixels)
    return float(BSpline.basis_element([-2, -1, 0, 1, 2])(a - np.array([-1.0, 0.0, 1.0, 2.0])) @ coefficients)


def test_the_local_cubic_is_a_spline_through_sixteen_pixels(rng: np.random.Generator) -> None:
    image = rng.uniform(0.0, 4095.0, (20, 20))
    x, y = rng.uniform(2.0, 16.0, (2, 50))
    expected = []
    for px, py in zip(x, y, strict=True):
        left, top = int(px) - 1, int(py) - 1
        rows = [local_cubic(image[top + j, left : left + 4], px - int(px)) for j in range(4)]
        expected.append(local_cubic(np.array(rows), py - int(py)))
    # Rounding: 16 products of numbers near 10^4.
    np.testing.assert_allclose(values_at(image, x, y, "local-cubic"), expected, atol=1e-9)


def test_slopes_of_the_local_cubic_are_those_of_a_quartic(rng: np.random.Generator) -> None:
    """The central difference of fourth order is exact for a polynomial of that order."""
    y, x = np.mgrid[0:12, 0:12] / 10.0
    image = 1.0 + x - 2.0 * y + x**4 - 3.0 * x**2 * y**2 + 0.5 * y**3
    along_x, along_y = spline_gradient(spline_coefficients(image, "local-cubic"), "local-cubic")
    inner = np.s_[2:-2, 2:-2]
    # Rounding: eight products near 10 over 12.
    np.testing.assert_allclose(along_x[inner], (0.1 * (1.0 + 4.0 * x**3 - 6.0 * x * y**2))[inner], atol=1e-12)
    np.testing.assert_allclose(along_y[inner], (0.1 * (1.5 * y**2 - 2.0 - 6.0 * x**2 * y))[inner], atol=1e-12)


def test_the_last_coefficients_of_all_are_enough(rng: np.random.Generator) -> None:
    """One instruction takes more columns than a quintic has taps: beyond the last row there are none."""
    image = rng.uniform(0.0, 4095.0, (30, 40))
    coefficients = spline_coefficients(image)
    # What a look beyond the coefficients would meet.
    inside = np.concatenate([coefficients.ravel(), np.full(8, np.nan)])[: coefficients.size]
    rows, columns = coefficients.shape
    first = np.array([(rows - 6) * columns + columns - 6, (rows - 6) * columns + columns - 7])
    found, s, t = np.empty(2), np.array([0.3, 0.6]), np.array([0.7, 0.2])
    spline_values(inside.reshape(rows, columns), KERNEL_CODE["quintic"], 2, first, s, t, found)
    weights = [BSpline.basis_element(np.arange(-3.0, 4.0))(np.arange(2.0, -4.0, -1.0) + a) for a in s]
    across = np.nan_to_num(weights)
    down = np.nan_to_num(
        [BSpline.basis_element(np.arange(-3.0, 4.0))(np.arange(2.0, -4.0, -1.0) + b) for b in t]
    )
    taps = [coefficients[-6:, -6:], coefficients[-6:, -7:-1]]
    expected = [down[k] @ taps[k] @ across[k] for k in range(2)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
