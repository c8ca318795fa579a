"""Sessions of exact geometry, and the figures of the group `calibration`."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.bench.groups.calibration import point_errors
from sms_jobs.bench.sessions.bar_session import (
    TABLE_3,
    SessionDesign,
    bar_session,
    seen_on_sphere,
    sphere_centres,
)
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.geometry.camera import project

SMALL = SessionDesign(
    points=30, camera_pixels=512, angles=TABLE_3[::3], board_tilts=((0.0, 0.0, 0.0), (0.3, 0.2, 0.0))
)


def test_the_bar_keeps_its_length_and_stands_upright_at_home() -> None:
    for angles in TABLE_3:
        low, high = sphere_centres(*angles, 500.0)
        assert np.linalg.norm(high - low) == pytest.approx(500.0)
    low, high = sphere_centres(0.0, 0.0, 500.0)
    np.testing.assert_allclose(high - low, [0.0, 500.0, 0.0], atol=1e-9)
    assert len(TABLE_3) == len(set(TABLE_3)) == 25


def test_points_lie_on_the_sphere_and_on_rays_of_whole_pixels(rng: np.random.Generator) -> None:
    made = bar_session(SMALL, 1)
    camera, projector = made.sensors[0], made.sensors[2]
    sphere = np.array([20.0, -40.0, 30.0, 30.0])
    pixels, points = seen_on_sphere(camera, projector, sphere, 50, rng)
    assert len(pixels) == 50
    np.testing.assert_array_equal(pixels, np.rint(pixels))
    # Coordinates of two metres have rounding of 1e-12 mm, grown by the angle of the surface.
    np.testing.assert_allclose(np.linalg.norm(points - sphere[:3], axis=1), 30.0, atol=1e-9)
    np.testing.assert_allclose(project(camera.intrinsics, camera.pose, points), pixels, atol=1e-8)
    towards = points - camera.pose.centre()
    assert np.all(np.sum(towards * (points - sphere[:3]), axis=1) < 0.0)


def test_a_session_has_the_noise_that_it_states() -> None:
    made = bar_session(SessionDesign(camera_pixels=512, angles=TABLE_3[:3]), 4)
    off = []
    for seen in made.problem.bar_points:
        centre = made.centres[seen.pose][seen.sphere - 1]
        image = project(made.sensors[seen.projector].intrinsics, made.sensors[seen.projector].pose, centre)
        off.append(np.abs(seen.projector_px - image).max())
        assert np.all(seen.sigma_px == 0.05)
    # Spheres of 30 mm are 39 px across in the projector.
    assert 10.0 < max(off) < 45.0
    assert len(made.problem.bar_points) == 3 * 4


def test_errors_of_points_are_those_of_the_calibration() -> None:
    made = bar_session(SMALL, 5)
    errors, sigmas = point_errors(made, adjust(made.problem), np.zeros((1, 3)))
    assert errors.shape == sigmas.shape == (4, 1, 3)
    # Twelve numbers that share one calibration; five sigma.
    assert np.all(np.abs(errors) < 5.0 * sigmas)
    assert np.all(sigmas < 0.1)
