"""The lens model, whatever it is: its derivatives, its kernels, and a table that says all of it."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.geometry import lens_kernels
from sms_jobs.metrology.geometry.lens import (
    COEFFICIENTS,
    LENS,
    PER_LENS,
    PIN_HOLE,
    Intrinsics,
    distort,
    distortion_jacobian,
    pixel_jacobian,
    undistort,
)

Floats = NDArray[np.float64]


@pytest.fixture
def bent(rng: np.random.Generator) -> Intrinsics:
    """A lens with some of every coefficient."""
    return Intrinsics.from_vector(
        np.concatenate([[1810.0, 1795.0, 321.3, 250.7], 0.05 * rng.uniform(-1.0, 1.0, len(COEFFICIENTS))])
    )


@pytest.fixture
def points(rng: np.random.Generator) -> Floats:
    """Normalised points as far out as images of measurement lenses reach, (50, 2)."""
    return rng.uniform(-0.25, 0.25, size=(50, 2))


def to_pixels(lens: Intrinsics, points: Floats) -> Floats:
    return distort(lens, points) * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def test_the_table_is_the_record() -> None:
    assert tuple(LENS) == tuple(f.name for f in fields(Intrinsics))
    assert tuple(LENS)[:PIN_HOLE] == ("fx", "fy", "cx", "cy")
    assert PIN_HOLE + len(COEFFICIENTS) == PER_LENS
    # A lens without distortion has no coefficients, and lies within its limits.
    assert not Intrinsics(1000.0, 1000.0, 300.0, 200.0).distortion().any()
    assert all(parameter.low < parameter.high for parameter in LENS.values())
    assert all(LENS[name].low <= 0.0 <= LENS[name].high for name in COEFFICIENTS)


def test_a_lens_comes_back_from_its_vector(bent: Intrinsics) -> None:
    assert Intrinsics.from_vector(bent.vector()) == bent


def test_derivatives_by_the_point_are_differences(bent: Intrinsics, points: Floats) -> None:
    found = distortion_jacobian(bent, points)
    for k, step in enumerate(1e-5 * np.eye(2)):
        expected = (distort(bent, points + step) - distort(bent, points - step)) / 2e-5
        # Truncation: step^2 / 6 times a third derivative below 10; rounding: 1e-16 / step.
        np.testing.assert_allclose(found[..., k], expected, atol=1e-9)


def test_derivatives_by_the_parameters_are_differences(bent: Intrinsics, points: Floats) -> None:
    found = pixel_jacobian(bent, points)
    for k in range(PER_LENS):
        step = np.zeros(PER_LENS)
        step[k] = 1e-4
        ahead, behind = (Intrinsics.from_vector(bent.vector() + sign * step) for sign in (1.0, -1.0))
        expected = (to_pixels(ahead, points) - to_pixels(behind, points)) / 2e-4
        # Pixels of 1e3 are known to 1e-13, over the step; truncation: step^2 times 1e3 px.
        np.testing.assert_allclose(found[..., k], expected, atol=2e-5)


def test_kernels_are_the_functions_for_arrays(bent: Intrinsics, points: Floats) -> None:
    lens, images, slopes, rows = bent.vector(), distort(bent, points), distortion_jacobian(bent, points), []
    for x, y in points:
        rows.append(np.zeros((2, len(COEFFICIENTS))))
        lens_kernels.by_parameters(lens, x, y, rows[-1])
    focal = np.array([[bent.fx], [bent.fy]])
    # The same formula twice: roundings of numbers up to 1, and of pixels.
    np.testing.assert_allclose([lens_kernels.distorted(lens, *p) for p in points], images, atol=1e-15)
    np.testing.assert_allclose(
        np.reshape([lens_kernels.by_point(lens, *p) for p in points], (-1, 2, 2)), slopes, atol=1e-14
    )
    np.testing.assert_allclose(rows * focal, pixel_jacobian(bent, points)[..., PIN_HOLE:], atol=1e-11)


def test_a_pixel_is_undistorted_with_its_derivatives(bent: Intrinsics, points: Floats) -> None:
    result = np.empty(6)
    for pixel, point in zip(to_pixels(bent, points), points, strict=True):
        assert lens_kernels.undistorted(bent.vector(), pixel, result)
        # Newton ends at 1e-12 of the focal length.
        np.testing.assert_allclose(result[:2], point, atol=1e-11)
        slope = np.array([[bent.fx], [bent.fy]]) * distortion_jacobian(bent, point)
        np.testing.assert_allclose(result[2:].reshape(2, 2) @ slope, np.eye(2), atol=1e-9)
    np.testing.assert_allclose(undistort(bent, distort(bent, points)), points, atol=1e-13)


def test_where_a_lens_folds_no_pixel_has_a_ray() -> None:
    # x (1 - x^2 / 2) is never above 0.545: nothing is imaged at 0.9.
    folding = Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=-0.5)
    assert not lens_kernels.undistorted(folding.vector(), np.array([900.0, 0.0]), np.empty(6))
