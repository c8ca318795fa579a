"""Points of a surface that was measured at some pixels only."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.deformation.strain.gauge_points import (
    MovedPoint,
    SparseSurface,
    extension,
    fitted_point,
    moved_point,
    place_of,
)

STEP, FIRST, SIDE = 4, 2, 50
SIGMA = 0.02
MM_PER_PX = 0.3


def seen(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
    """Return the point that a pixel sees: a shallow bowl, which is turned against the image."""
    return np.stack([MM_PER_PX * (x + 0.2 * y), MM_PER_PX * (y - 0.1 * x), 1e-3 * (0.5 * x * x + x * y)])


def bowl(rng: np.random.Generator | None = None) -> SparseSurface:
    places = FIRST + STEP * np.arange(SIDE)
    xyz = seen(*np.meshgrid(places, places))
    if rng is not None:
        xyz = xyz + rng.normal(0.0, SIGMA, xyz.shape)
    covariance = np.zeros((6, SIDE, SIDE))
    covariance[[0, 3, 5]] = SIGMA**2
    return SparseSurface(xyz, covariance, np.ones((SIDE, SIDE), np.int32), STEP, FIRST)


def test_a_quadratic_surface_is_met_between_its_pixels() -> None:
    found = fitted_point(bowl(), 101.3, 77.9, 16.0)
    assert found is not None
    # A quadratic is fitted exactly: rounding alone is left, of some 1e2 mm and a condition of 1e2.
    assert found.position == pytest.approx(seen(101.3, 77.9), abs=1e-10)
    slope = np.array([[MM_PER_PX, 0.2 * MM_PER_PX], [-0.1 * MM_PER_PX, MM_PER_PX], [0.1792, 0.1013]])
    assert found.slope == pytest.approx(slope, abs=1e-10)


def test_points_scatter_as_predicted() -> None:
    errors, predicted = [], []
    for seed in range(200):
        found = fitted_point(bowl(np.random.default_rng(seed)), 101.3, 77.9, 16.0)
        assert found is not None
        errors.append(found.position - seen(101.3, 77.9))
        predicted.append(np.diag(found.covariance))
    # 600 numbers: their variance scatters by sqrt(2 / 600) = 6 %. Of noise and residual, 43
    # degrees of freedom with a scatter of 13 % over three axes, the larger is stated, on average 5 % more.
    ratio = np.mean(np.square(errors)) / np.mean(predicted)
    assert 1.0 / 1.05 - 3.0 * 0.06 < ratio < 1.0 + 3.0 * 0.06


def test_beyond_what_is_measured_there_is_no_point() -> None:
    surface = bowl()
    assert fitted_point(surface, 230.0, 77.9, 16.0) is None
    surface.labels[:, 25:] = 0
    at_edge = FIRST + STEP * 24.0
    assert fitted_point(surface, at_edge - 12.0, 77.9, 16.0) is not None
    assert fitted_point(surface, at_edge + STEP, 77.9, 16.0) is None


def test_a_place_is_found_in_the_image() -> None:
    surface = bowl()
    x_mm, y_mm, _ = seen(101.0, 77.0)
    # Places along x and y are linear in those of the image here: rounding alone is left.
    assert place_of(surface, x_mm, y_mm, 16.0) == pytest.approx((101.0, 77.0), abs=1e-9)
    assert place_of(surface, -50.0, y_mm, 16.0) is None


def test_an_extension_is_the_growth_of_a_distance_whatever_the_rotation() -> None:
    rng = np.random.default_rng(5)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    none = np.zeros((3, 3))
    one, other = np.array([1.0, 2.0, 3.0]), np.array([31.0, 2.0, 43.0])
    moved = [MovedPoint(at, 1.002 * turn @ at + [5.0, 0.0, -3.0], none) for at in (one, other)]
    found, sigma = extension(*moved)
    assert found == pytest.approx(0.002 * 50.0, abs=1e-12)  # rounding of 50 mm
    assert sigma == 0.0


def test_the_error_of_a_match_goes_along_the_slopes() -> None:
    still = fitted_point(bowl(), 101.0, 77.0, 16.0)
    assert still is not None
    quiet, noisy = moved_point(still, still, np.zeros(2)), moved_point(still, still, np.array([0.1, 0.0]))
    added = np.diag(noisy.covariance - quiet.covariance)
    assert added == pytest.approx(0.01 * still.slope[:, 0] ** 2, rel=1e-9)  # rounding
