"""Fields are never interpolated across an edge."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.images.interpolation import interpolate_in_region


def test_inside_a_region_cubics_are_exact(rng: np.random.Generator) -> None:
    y, x = np.mgrid[0:20, 0:24].astype(np.float64)
    c = rng.normal(size=(4, 4))
    field = np.polynomial.polynomial.polyval2d(x / 10.0, y / 10.0, c)[None]
    px, py = rng.uniform(2.0, 17.0, (2, 5, 9))
    value, _, slope = interpolate_in_region(field, np.zeros((1, 20, 24)), np.ones((20, 24), np.int32), px, py)
    expected = np.polynomial.polynomial.polyval2d(px / 10.0, py / 10.0, c)
    along_x = np.polynomial.polynomial.polyval2d(
        px / 10.0, py / 10.0, np.polynomial.polynomial.polyder(c, axis=0)
    )
    # Rounding of sums of sixteen numbers below 10^3.
    np.testing.assert_allclose(value[0], expected, atol=1e-11)
    np.testing.assert_allclose(slope[0, 0], along_x / 10.0, atol=1e-11)


def test_regions_are_never_mixed(rng: np.random.Generator) -> None:
    # Two planes a metre apart meet along a ragged edge; a plane fit is exact on each right up to it.
    y, x = np.mgrid[0:40, 0:40].astype(np.float64)
    right = x > 20.0 + 3.0 * np.sin(y / 4.0)
    labels = np.where(right, 2, 1).astype(np.int32)
    labels[5:8, 5:8] = 0
    field = np.where(right, 1000.0 - 2.0 * x + y, x + 0.5 * y)[None]
    field[0, labels == 0] = np.nan
    px, py = rng.uniform(0.0, 39.0, (2, 30, 30))
    value, _, _ = interpolate_in_region(field, np.zeros((1, 40, 40)), labels, px, py)
    expected = np.stack([px + 0.5 * py, 1000.0 - 2.0 * px + py])
    known = np.isfinite(value[0])
    # Rounding of a fit to numbers of 10^3.
    assert np.abs(value[0] - expected)[:, known].min(axis=0).max() < 1e-8
    assert known.mean() > 0.97


def test_variance_is_that_of_the_interpolated_noise(rng: np.random.Generator) -> None:
    labels = np.ones((12, 12), np.int32)
    labels[:, 8:] = 0
    x, y = np.array([[3.5, 4.2, 7.3]]), np.array([[4.5, 5.1, 6.4]])
    noise = rng.normal(size=(4000, 12, 12))
    value, spread, _ = interpolate_in_region(noise, np.ones((1, 12, 12)), labels, x, y)
    # 4000 trials give a variance to sqrt(2 / 4000) = 2.2 %: four of those.
    np.testing.assert_allclose(value.var(axis=0), spread[0], rtol=0.09)


@pytest.mark.parametrize("place", [(-0.1, 5.0), (5.0, 19.1), (np.nan, 3.0)])
def test_outside_there_is_nothing(place: tuple[float, float]) -> None:
    field = np.ones((1, 20, 20))
    x, y = np.array([[place[0]]]), np.array([[place[1]]])
    value, spread, slope = interpolate_in_region(field, field, np.ones((20, 20), np.int32), x, y)
    assert np.isnan(value).all()
    assert np.isnan(spread).all()
    assert np.isnan(slope).all()


def test_threads_do_not_matter(rng: np.random.Generator) -> None:
    field = rng.normal(size=(3, 90, 30))
    labels = (rng.random((90, 30)) > 0.1).astype(np.int32)
    x, y = rng.uniform(0.0, 29.0, (2, 200, 10))
    one = interpolate_in_region(field, field, labels, x, y, threads=1)
    three = interpolate_in_region(field, field, labels, x, y, threads=3)
    for a, b in zip(one, three, strict=True):
        np.testing.assert_array_equal(a, b)
