"""Points of two views are laid on each other as well as they are known, and results with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.calibration.rigid_alignment import rigid_modes
from sms_jobs.metrology.deformation.joining.alignment import CommonPoints, align_views
from sms_jobs.metrology.deformation.joining.common_frame import (
    StrainedSurface,
    brought,
    differences,
    turned_in_plane,
)
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import compose, inverse, pack, rotation_vector, transform

TRUE = Pose.from_arrays(Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix(), np.array([150.0, -20.0, 30.0]))
START = Pose.from_arrays(Rotation.from_rotvec([0.21, -0.3, 0.39]).as_matrix(), np.array([151.0, -19.0, 30.0]))


def noisy(rng: np.random.Generator, count: int = 60) -> tuple[CommonPoints, np.ndarray]:
    """Return points of a shallow shell, known to 20 um along one direction in each frame, 2 um across."""
    place = rng.uniform(-60.0, 60.0, (count, 3))
    place[:, 2] = 1e-3 * (place[:, 0] ** 2 - place[:, 1] ** 2)
    rays = np.array([[0.3, 0.1, 1.0], [-0.1, 0.2, 1.0]])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    roots = [0.002 * np.eye(3) + 0.018 * np.outer(ray, ray) for ray in rays]
    here = place + rng.normal(size=place.shape) @ roots[0]
    there = transform(inverse(TRUE), place) + rng.normal(size=place.shape) @ roots[1]
    packed = [np.repeat(pack(root @ root)[:, None], count, axis=1) for root in roots]
    return CommonPoints(here, there, *packed), place


def error_of(pose: Pose) -> np.ndarray:
    """Return the small turn and shift by which a pose is off the true one."""
    off = compose(pose, inverse(TRUE))
    return np.r_[rotation_vector(off.matrix()), off.translation]


def test_the_pose_scatters_as_its_covariance_says(rng: np.random.Generator) -> None:
    trials = 150
    squares, scales = [], []
    for _ in range(trials):
        found = align_views(noisy(rng)[0], START)
        error = error_of(found.pose)
        squares.append(error @ np.linalg.solve(found.covariance / found.scale**2, error))
        scales.append(found.scale)
    # The squares are chi-square of 6: mean 6, and its mean over the trials is known to sqrt(12 / 150) = 0.28.
    assert np.mean(squares) == pytest.approx(6.0, abs=4 * 0.28)
    # The median of 60 lengths is known to about 6 %, and below 1 it counts as 1.
    assert 1.0 <= np.mean(scales) < 1.1


def test_points_without_noise_give_the_exact_pose(rng: np.random.Generator) -> None:
    points, place = noisy(rng)
    exact = replace(points, here=place, there=transform(inverse(TRUE), place))
    found = align_views(exact, START)
    # Rounding of positions of 100 mm, and the last step, below a nanometre.
    assert np.abs(error_of(found.pose)).max() < 1e-9
    assert found.rms_mm < 1e-9
    assert found.used.all()


def test_a_third_of_wrong_points_changes_nothing_but_their_number(rng: np.random.Generator) -> None:
    points, _ = noisy(rng, 90)
    wrong = points.there.copy()
    wrong[:30] += rng.uniform(1.0, 20.0, (30, 3))
    good = align_views(
        CommonPoints(
            points.here[30:],
            points.there[30:],
            points.covariance_here[:, 30:],
            points.covariance_there[:, 30:],
        ),
        START,
    )
    found = align_views(replace(points, there=wrong), START)
    assert not found.used[:30].any()
    np.testing.assert_array_equal(found.used[30:], good.used)
    # The same points, from another start: the last step is below a nanometre.
    np.testing.assert_allclose(error_of(found.pose), error_of(good.pose), atol=1e-8)


def test_too_few_points_are_refused(rng: np.random.Generator) -> None:
    points, _ = noisy(rng, 11)
    with pytest.raises(MeasurementFailed, match="11 points in common and their alignment needs 12"):
        align_views(points, START)


def curved(rng: np.random.Generator) -> StrainedSurface:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 21.0), np.arange(0.0, 16.0)))
    vertices = np.column_stack([x, y, 0.01 * x**2 - 0.02 * x * y])
    n = np.arange(x.size).reshape(16, 21)
    a, b, c, d = n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]).astype(np.int32)
    sigma = np.full(x.size, 0.01)
    linear = np.stack([1.0 + 0.01 * x, -0.02 * y, 0.03 * x + 0.01 * y])
    return StrainedSurface(
        vertices, faces, linear, sigma, rng.normal(size=(3, x.size)), np.full((3, x.size), 0.1)
    )


def test_strain_turns_as_a_tensor() -> None:
    angle = np.array([0.3, -1.2, np.pi / 2])
    strain = np.array([[1.0, 2.0, 3.0], [-0.5, 0.1, 1.0], [0.2, -0.7, 0.4]])
    turned, sigma = turned_in_plane(strain, np.ones((3, 3)), angle)
    for k, a in enumerate(angle):
        r = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        full = r @ np.array([[strain[0, k], strain[2, k]], [strain[2, k], strain[1, k]]]) @ r.T
        np.testing.assert_allclose(turned[:, k], [full[0, 0], full[1, 1], full[0, 1]], atol=1e-14)
    # By a quarter of a turn x becomes y, and the sigmas stay.
    np.testing.assert_allclose(sigma[:, 2], 1.0, atol=1e-14)


def test_what_is_brought_over_and_back_is_what_it_was(rng: np.random.Generator) -> None:
    surface, axis = curved(rng), np.array([1.0, 0.0, 0.0])
    for there in (TRUE.matrix() @ axis, TRUE.matrix() @ np.array([0.6, 0.8, 0.0])):
        moved = brought(surface, TRUE, there, axis)
        # Principal strains know no axes.
        one, other = surface.strain, moved.strain
        np.testing.assert_allclose(one[0] + one[1], other[0] + other[1], atol=1e-12)
        np.testing.assert_allclose(
            np.hypot(one[0] - one[1], 2 * one[2]), np.hypot(other[0] - other[1], 2 * other[2]), atol=1e-12
        )
        back = brought(moved, inverse(TRUE), axis, there)
        np.testing.assert_allclose(back.vertices, surface.vertices, atol=1e-10)
        np.testing.assert_allclose(back.displacement, surface.displacement, atol=1e-12)
        np.testing.assert_allclose(back.strain, surface.strain, atol=1e-12)
    same = brought(surface, TRUE, TRUE.matrix() @ axis, axis)
    np.testing.assert_allclose(same.strain, surface.strain, atol=1e-12)


def test_views_differ_where_they_overlap(rng: np.random.Generator) -> None:
    first = curved(rng)
    shift = np.array([10.5, 0.0, 0.0])
    place = first.vertices + shift
    height = 0.01 * place[:, 0] ** 2 - 0.02 * place[:, 0] * place[:, 1]
    x, y = place[:, 0], place[:, 1]
    field = np.stack([1.0 + 0.01 * x, -0.02 * y, 0.03 * x + 0.01 * y]) + np.array([[0.02], [0.0], [0.0]])
    second = replace(first, vertices=np.column_stack([x, y, height]), displacement=field)
    apart, pairs = differences([first, second])
    met = np.isfinite(apart[0])
    # From 1.5 edges of at least 1 mm before the second one's first vertices on, at x = 10.5 mm.
    np.testing.assert_array_equal(np.unique(first.vertices[met][:, 0]), np.arange(9.0, 21.0))
    # The field is linear over the surface's plane but not over its bend: 0.03 x 0.01 x 1^2 of sag.
    np.testing.assert_allclose(apart[0][met], 0.02, atol=1e-3)
    assert np.isnan(apart[1]).all()
    np.testing.assert_allclose(pairs[0, 1][:, 1], 2 * 0.01**2, rtol=1e-6)
    assert set(pairs) == {(0, 1)}


def test_the_modes_are_those_of_the_error(rng: np.random.Generator) -> None:
    # A small motion after the pose moves points by its modes: the covariance is of this motion.
    points = rng.normal(size=(5, 3)) * 100.0
    motion = 1e-6 * rng.normal(size=6)
    turned = Pose.from_arrays(Rotation.from_rotvec(motion[:3]).as_matrix(), motion[3:])
    # The square of the turn times the distance is neglected: 1e-12 x 300.
    np.testing.assert_allclose(transform(turned, points) - points, rigid_modes(points) @ motion, atol=1e-9)
