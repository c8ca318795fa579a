"""The lens model, whatever it is: its derivatives, its kernels, and a table that says all of it."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.geometry import lens_kernels
from sms_jobs.metrology.geometry.camera import pixel_grid
from sms_jobs.metrology.geometry.lens import (
    COEFFICIENTS,
    LENS,
    MODELS,
    PER_LENS,
    PIN_HOLE,
    Intrinsics,
    Model,
    distort,
    distortion_jacobian,
    foreign,
    pixel_jacobian,
    undistort,
)
from sms_jobs.metrology.geometry.lens_field import fold_px, fold_radius

Floats = NDArray[np.float64]

COLUMNS, ROWS = 1600, 1200
WIDE = {
    "rational": Intrinsics(
        720.0, 722.0, 810.0, 590.0, 0.9, 0.1, 2e-4, -3e-4, 0.003, k4=1.2, k5=0.28, k6=0.015
    ),
    "fisheye": Intrinsics(
        650.0, 648.0, 805.0, 596.0, 0.03, -0.01, k3=0.004, skew=1e-3, k4=-0.001, fisheye=1.0
    ),
}
"""Of 1600 x 1200 px, which reach 77 and 86 degrees from the axis."""


@pytest.fixture(params=WIDE)
def wide(request: pytest.FixtureRequest) -> Intrinsics:
    return WIDE[request.param]


@pytest.fixture(params=MODELS)
def bent(request: pytest.FixtureRequest, rng: np.random.Generator) -> Intrinsics:
    """A lens of each model with some of every coefficient that it has."""
    model: Model = request.param
    values = 0.05 * rng.uniform(-1.0, 1.0, len(COEFFICIENTS))
    values[[name in foreign(model) for name in COEFFICIENTS]] = 0.0
    values[COEFFICIENTS.index("fisheye")] = float(model == "fisheye")
    if model == "fisheye":
        values[[COEFFICIENTS.index(name) for name in ("p1", "p2")]] = 0.0
    return Intrinsics.from_vector(np.concatenate([[1810.0, 1795.0, 321.3, 250.7], values]))


@pytest.fixture
def points(bent: Intrinsics, rng: np.random.Generator) -> Floats:
    """Normalised points as far out as images of measurement lenses reach, (50, 2); of a fisheye 65
    degrees."""
    return rng.uniform(-1.0, 1.0, size=(50, 2)) * (1.5 if bent.fisheye else 0.25)


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


def test_many_pixels_are_undistorted_as_each_by_itself(bent: Intrinsics, points: Floats) -> None:
    folding, radius = FOLDING["plain"]
    beyond = 1.02 * folding.fx * radius
    for lens, pixels in (
        (bent.vector(), to_pixels(bent, points).T),
        (bent.vector(), np.array([[300.0, np.nan, 321.3], [np.nan, 250.0, 250.7]])),
        # Where some pixels have no ray, and where all have one.
        (folding.vector(), np.array([[0.0, beyond, 500.0, 0.5 * beyond], [0.0, 0.0, 20.0, 3.0]])),
        (folding.vector(), np.array([[0.0, 500.0, 10.0], [0.0, 20.0, 3.0]])),
    ):
        which = np.arange(pixels.shape[1])[::-2].copy()
        result = np.empty((6, len(which)))
        lens_kernels.undistort_some(lens, np.ascontiguousarray(pixels), which, result)
        for k, number in enumerate(which):
            one = np.full(6, np.nan)
            if lens_kernels.undistorted(lens, pixels[:, number].copy(), one):
                np.testing.assert_array_equal(result[:, k], one)
            else:
                assert np.isnan(result[:, k]).all()


def test_a_wide_lens_is_undone_over_its_whole_sensor(wide: Intrinsics) -> None:
    assert fold_px(wide, COLUMNS, ROWS) is None
    pixels = pixel_grid(ROWS, COLUMNS)[::7, ::7].reshape(-1, 2)
    corners = np.array([(x, y) for x in (-0.5, COLUMNS - 0.5) for y in (-0.5, ROWS - 0.5)])
    pixels = np.concatenate([pixels, corners])
    target = (pixels - [wide.cx, wide.cy]) / [wide.fx, wide.fy]
    back = to_pixels(wide, undistort(wide, target))
    # Newton ends at 1e-14 of the focal length of 600 px, or at the rounding of radii up to 10.
    np.testing.assert_allclose(back, pixels, rtol=0.0, atol=1e-9)
    result = np.empty(6)
    for pixel in pixels[::11]:
        assert lens_kernels.undistorted(wide.vector(), pixel, result)
        # The kernel's Newton ends at 1e-12 of the focal length.
        np.testing.assert_allclose(to_pixels(wide, result[None, :2])[0], pixel, rtol=0.0, atol=1e-9)


def test_a_fisheye_has_no_ray_from_90_degrees_on() -> None:
    lens = Intrinsics(600.0, 600.0, 0.0, 0.0, fisheye=1.0)
    just, beyond = 600.0 * 0.5 * np.pi * np.array([0.999, 1.001])
    assert lens_kernels.undistorted(lens.vector(), np.array([just, 0.0]), np.empty(6))
    assert not lens_kernels.undistorted(lens.vector(), np.array([beyond, 0.0]), np.empty(6))
    found = undistort(lens, np.array([[just, 0.0], [beyond, 0.0], [0.0, 0.0]]) / 600.0)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=1), [True, False, True])


FOLDING = {
    # r (1 - r^2 / 2) grows while 1.5 r^2 < 1.
    "plain": (Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=-0.5), np.sqrt(1.0 / 1.5)),
    # r / (1 + r^2) grows while r < 1.
    "rational": (Intrinsics(1000.0, 1000.0, 0.0, 0.0, k4=1.0), 1.0),
    # theta (1 - theta^2 / 3) grows while theta < 1.
    "fisheye": (Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=-1.0 / 3.0, fisheye=1.0), np.tan(1.0)),
}


@pytest.mark.parametrize("model", FOLDING)
def test_a_fold_is_found_where_it_is(model: str) -> None:
    lens, radius = FOLDING[model]
    assert lens.model == model
    # Roots of polynomials of degree five are known to some roundings.
    assert fold_radius(lens) == pytest.approx(radius, rel=1e-9)
    edge = float(to_pixels(lens, np.array([[radius, 0.0]]))[0, 0])
    found = fold_px(lens, 1, 4000)
    assert found is not None
    assert found == pytest.approx((edge, np.hypot(0.5, 3999.5)), rel=1e-9)
    assert fold_px(lens, 1, int(edge) - 2) is None
    # A pixel within the fold has the ray on this side of it, one beyond has none.
    result = np.empty(6)
    assert lens_kernels.undistorted(lens.vector(), np.array([0.99 * edge, 0.0]), result)
    assert 0.0 < result[0] < radius
    assert not lens_kernels.undistorted(lens.vector(), np.array([1.01 * edge, 0.0]), result)


@pytest.mark.parametrize("next_to_nothing", [1e-20, -1e-20, 1e-300, -1e-300])
def test_a_fold_is_found_beside_coefficients_of_next_to_nothing(next_to_nothing: float) -> None:
    lens, radius = FOLDING["plain"]
    assert fold_radius(replace(lens, k2=next_to_nothing)) == pytest.approx(radius, rel=1e-9)
    assert fold_radius(replace(lens, k3=next_to_nothing)) == pytest.approx(radius, rel=1e-9)


@pytest.mark.parametrize(
    "lens",
    [
        Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=0.1, k2=0.2),
        Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=1e-300),
        Intrinsics(1000.0, 1000.0, 0.0, 0.0, k4=-0.5),  # to infinity at r = 1.41, which nothing is beyond
        Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=0.1, fisheye=1.0),
    ],
)
def test_a_lens_that_grows_folds_nowhere(lens: Intrinsics) -> None:
    assert fold_radius(lens) == np.inf


def test_where_a_lens_folds_no_pixel_has_a_ray() -> None:
    # x (1 - x^2 / 2) is never above 0.545: nothing is imaged at 0.9.
    folding = Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=-0.5)
    assert not lens_kernels.undistorted(folding.vector(), np.array([900.0, 0.0]), np.empty(6))
