"""The camera model: as OpenCV has it, invertible, and with exact derivatives."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.camera import (
    Pose,
    pixel_grid,
    pixel_maps,
    project,
    projection_jacobian,
    ray_directions,
)
from sms_jobs.metrology.geometry.lens import Intrinsics, distort, distortion_jacobian, undistort

Floats = NDArray[np.float64]

LENS = Intrinsics(1810.0, 1795.0, 321.3, 250.7, k1=-0.12, k2=0.09, p1=4e-4, p2=-3e-4, k3=0.02)
POSE = Pose.looking_at(
    np.array([-350.0, 60.0, 1000.0]), np.array([10.0, -5.0, 0.0]), np.array([0.1, 1.0, 0.0])
)


@pytest.fixture
def points(rng: np.random.Generator) -> Floats:
    """Points of a measurement volume in front of the sensor, (200, 3) in mm."""
    return rng.uniform([-170.0, -140.0, -60.0], [170.0, 140.0, 60.0], size=(200, 3))


def test_projection_is_that_of_opencv(points: Floats) -> None:
    rotation, _ = cv2.Rodrigues(POSE.matrix())
    expected, _ = cv2.projectPoints(
        points, rotation, np.array(POSE.translation), LENS.matrix(), LENS.distortion()[:5]
    )
    # Two evaluations of one formula in double precision: a pixel of 640 is known to 1e-13, and the rotation
    # vector of the other loses a few digits more.
    np.testing.assert_allclose(project(LENS, POSE, points), expected[:, 0], rtol=0.0, atol=1e-9)


WIDE_POINTS = np.array([-1500.0, -900.0, 200.0]), np.array([1500.0, 900.0, 900.0])


def test_a_rational_lens_is_that_of_opencv(rng: np.random.Generator) -> None:
    lens = Intrinsics(720.0, 722.0, 810.0, 590.0, 0.9, 0.1, 2e-4, -3e-4, 0.003, k4=1.2, k5=0.28, k6=0.015)
    points = rng.uniform(*WIDE_POINTS, (200, 3))
    coefficients = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix(), coefficients)
    upright = Pose.from_arrays(np.eye(3), np.zeros(3))
    # One formula twice; numbers up to 7.5^6 and pixels up to 1e4, known to 1e-12.
    np.testing.assert_allclose(project(lens, upright, points), expected[:, 0], rtol=1e-12, atol=1e-9)


def test_a_fisheye_is_that_of_opencv(rng: np.random.Generator) -> None:
    lens = Intrinsics(650.0, 648.0, 805.0, 596.0, 0.03, -0.01, k3=0.004, skew=1e-3, k4=-0.001, fisheye=1.0)
    points = rng.uniform(*WIDE_POINTS, (200, 3))
    expected, _ = cv2.fisheye.projectPoints(
        points[None],
        np.zeros(3),
        np.zeros(3),
        replace(lens, skew=0.0).matrix(),
        np.array([lens.k1, lens.k2, lens.k3, lens.k4]),
        alpha=lens.skew,
    )
    upright = Pose.from_arrays(np.eye(3), np.zeros(3))
    # One formula twice, pixels up to 2e3.
    np.testing.assert_allclose(project(lens, upright, points), expected[0], rtol=0.0, atol=1e-9)


def test_the_skew_moves_along_the_row_by_the_distance_from_the_principal_point(points: Floats) -> None:
    skewed = replace(LENS, skew=2e-3)
    straight = project(LENS, POSE, points)
    # K of a skewed image: fx x' + (fx skew) y' + cx, where y' is (v - cy) / fy.
    shift = LENS.fx * 2e-3 * (straight[:, 1] - LENS.cy) / LENS.fy
    expected = straight + np.stack([shift, np.zeros_like(shift)], axis=1)
    np.testing.assert_allclose(project(skewed, POSE, points), expected, atol=1e-11)  # rounding at 1e3 px
    assert skewed.matrix()[0, 1] == LENS.fx * 2e-3


def test_a_point_on_the_axis_falls_on_the_principal_point() -> None:
    axis = POSE.centre() + 777.0 * POSE.matrix()[2]
    # Distances of 1e3 mm are known to 1e-13 mm, times a focal length of 1.8e3 px over 777 mm.
    np.testing.assert_allclose(project(LENS, POSE, axis), [LENS.cx, LENS.cy], atol=1e-10)


def test_a_sensor_that_looks_at_a_point_stands_upright() -> None:
    pose = Pose.looking_at(np.array([0.0, 0.0, 1000.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(pose.centre(), [0.0, 0.0, 1000.0], atol=1e-10)  # rounding at 1e3 mm
    centre, above, right = project(
        LENS, pose, np.array([(0.0, 0.0, 0.0), (0.0, 10.0, 0.0), (10.0, 0.0, 0.0)])
    )
    assert above[1] < centre[1]  # y of the image points down
    assert right[0] > centre[0]
    assert np.linalg.det(pose.matrix()) == pytest.approx(1.0, abs=1e-14)  # right-handed, up to rounding


def test_points_behind_the_pin_hole_are_not_seen() -> None:
    behind = POSE.centre() - 100.0 * POSE.matrix()[2]
    assert np.isnan(project(LENS, POSE, np.stack([behind, POSE.centre()]))).all()


def test_undistorting_inverts_distorting(rng: np.random.Generator) -> None:
    # The image reaches to 0.23 focal lengths from its middle; Newton's method ends at 1e-14.
    normalised = rng.uniform(-0.25, 0.25, size=(500, 2))
    np.testing.assert_allclose(undistort(LENS, distort(LENS, normalised)), normalised, atol=1e-13)


def test_where_a_lens_has_no_inverse_there_is_no_ray() -> None:
    # x (1 - 0.5 x^2) is never above 0.545: nothing is imaged at 0.9.
    folding = Intrinsics(1000.0, 1000.0, 0.0, 0.0, k1=-0.5)
    assert np.isnan(undistort(folding, np.array([[0.9, 0.0]]))).all()
    assert np.isfinite(undistort(folding, np.array([[0.4, 0.0]]))).all()


def test_a_ray_passes_through_the_point_that_is_projected(points: Floats) -> None:
    directions = ray_directions(LENS, POSE, project(LENS, POSE, points))
    away = points - POSE.centre()
    distance = np.linalg.norm(np.cross(away, directions), axis=-1)
    # 1e-14 focal lengths at 1.1e3 mm, and the rounding of pixels: 1e-13 px * 0.6 mm/px.
    assert distance.max() < 1e-10
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-14)
    assert (np.sum(away * directions, axis=-1) > 0.0).all()


def central_differences(function: object, at: Floats, step: float) -> Floats:
    """Return d(function)/d(last axis of at), (..., outputs, inputs)."""
    columns = []
    for axis in range(at.shape[-1]):
        offset = np.zeros(at.shape[-1])
        offset[axis] = step
        columns.append((function(at + offset) - function(at - offset)) / (2.0 * step))  # type: ignore[operator]
    return np.stack(columns, axis=-1)


def test_distortion_jacobian_is_the_derivative(rng: np.random.Generator) -> None:
    at = rng.uniform(-0.25, 0.25, size=(50, 2))
    expected = central_differences(lambda p: distort(LENS, p), at, 1e-5)
    # Truncation: step^2 / 6 times a third derivative below 10; rounding: 1e-16 / step.
    np.testing.assert_allclose(distortion_jacobian(LENS, at), expected, atol=1e-9)


def test_projection_jacobian_is_the_derivative(points: Floats) -> None:
    expected = central_differences(lambda p: project(LENS, POSE, p), points, 1e-2)
    # Pixels of 1e3 are known to 1e-13: 1e-11 px/mm; truncation is step^2 times 1.8 px/mm / (1e3 mm)^2.
    np.testing.assert_allclose(projection_jacobian(LENS, POSE, points), expected, atol=1e-9)


def test_pixel_centres_count_from_zero() -> None:
    grid = pixel_grid(3, 5)
    assert grid.shape == (3, 5, 2)
    assert tuple(grid[0, 0]) == (0.0, 0.0)
    assert tuple(grid[2, 4]) == (4.0, 2.0)
    np.testing.assert_array_equal(pixel_maps(3, 5), np.moveaxis(grid, -1, 0))
