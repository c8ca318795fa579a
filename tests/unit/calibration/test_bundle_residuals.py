"""Residuals of the bundle adjustment: derivatives by finite differences, and what they mean."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.calibration.bundle.covariance import point_jacobian
from sms_jobs.metrology.calibration.bundle.rays import along_change, gap_change
from sms_jobs.metrology.calibration.bundle.residuals import (
    BOARD_SIZE,
    SPHERE_SIZE,
    board_rows,
    meet_sphere,
    ray_distances,
    room_of_sphere,
    sphere_rows,
)
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose, project, projection_jacobian, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics, pixel_jacobian

Floats = NDArray[np.float64]

CAMERA = Intrinsics(2000.0, 2010.0, 515.0, 505.0, k1=-0.08, k2=0.12, p1=2e-4, p2=-3e-4, k3=0.05)
PROJECTOR = Intrinsics(1600.0, 1590.0, 520.0, 380.0, k1=-0.05, k2=0.08, p1=-4e-4, p2=2e-4, k3=-0.03)
FLATTEST = 0.1


def standing(centre: tuple[float, float, float], roll: float) -> Pose:
    up = np.array([np.sin(roll), np.cos(roll), 0.0])
    return Pose.looking_at(np.array(centre), np.array([10.0, -5.0, 3.0]), up)


POSES = (standing((-600.0, 100.0, 1500.0), 0.1), standing((500.0, -50.0, 1400.0), -0.2))
SENSORS = np.concatenate([np.zeros((2, 6)), np.stack([CAMERA.vector(), PROJECTOR.vector()])], axis=1)
SPHERE = np.array([20.0, -30.0, 15.0, 30.0])


def arrays(sensors: Floats) -> tuple[Floats, Floats, Floats]:
    """Return rotation, translation and lens of sensors, whose first six parameters are changes of `POSES`."""
    turn = Rotation.from_rotvec(sensors[:, :3]).as_matrix()
    rotation = turn @ np.stack([p.matrix() for p in POSES])
    translation = np.array([p.translation for p in POSES]) + sensors[:, 3:6]
    return rotation, translation, np.ascontiguousarray(sensors[:, 6:])


def camera_models(sensors: Floats) -> list[tuple[Intrinsics, Pose]]:
    rotation, translation, lens = arrays(sensors)
    return [(Intrinsics(*lens[k]), Pose.from_arrays(rotation[k], translation[k])) for k in (0, 1)]


def slopes(function: Callable[[Floats], Floats], at: Floats, steps: Floats) -> Floats:
    """Return derivatives by central differences, extrapolated from two steps: the error is of order 4."""
    columns = []
    for k, step in enumerate(steps):
        off = np.zeros_like(at)
        off[k] = step
        one = (function(at + off) - function(at - off)) / (2.0 * step)
        two = (function(at + 2.0 * off) - function(at - 2.0 * off)) / (4.0 * step)
        columns.append((4.0 * one - two) / 3.0)
    return np.stack(columns, axis=-1)


CORNER = np.array([[0.3, 0.2]])
SLOPES = np.abs(pixel_jacobian(CAMERA, CORNER)).max(axis=(0, 1))
STEPS = np.concatenate([[1e-4] * 3, [0.1] * 3, 1.0 / np.where(SLOPES > 0.0, SLOPES, 1e6)])
"""Steps that move an image by up to a pixel: rounding of 1e-13 px, and a step to the fourth, are nothing."""


def seen_pixel(offset: tuple[float, float, float]) -> Floats:
    """Return the camera's pixel of a point near the sphere's front."""
    front = SPHERE[:3] + np.array(offset)
    return project(*camera_models(SENSORS)[0], front[None])[0]


@pytest.mark.parametrize("offset", [(0.0, 0.0, 30.0), (-20.0, 10.0, 15.0), (12.0, -24.0, 5.0)])
def test_sphere_derivatives_are_finite_differences(offset: tuple[float, float, float]) -> None:
    camera_px = seen_pixel(offset)
    rows, along, pixel = np.zeros((2, SPHERE_SIZE)), np.empty(2), np.empty(2)

    def predicted(parameters: Floats) -> Floats:
        rotation, translation, lens = arrays(parameters[:-4].reshape(2, PER_SENSOR))
        out = np.empty(2)
        sphere_rows(
            rotation, translation, lens, (0, 1), camera_px, parameters[-4:], FLATTEST, out,
            np.zeros((2, SPHERE_SIZE)), np.empty(2), room_of_sphere(),
        )  # fmt: skip
        return out

    at = np.concatenate([SENSORS.ravel(), SPHERE])
    room = room_of_sphere()
    cosine = sphere_rows(*arrays(SENSORS), (0, 1), camera_px, SPHERE, FLATTEST, pixel, rows, along, room)
    assert FLATTEST < cosine <= 1.0
    wanted = slopes(predicted, at, np.concatenate([0.1 * STEPS, STEPS, np.full(4, 1e-2)]))
    # The lens is undone to 1e-12 of the focal length, 2e-9 px, over 0.1 px; grazing grows it tenfold.
    scale = np.abs(wanted).max(axis=0) + 1e-3
    np.testing.assert_allclose(rows / scale, wanted / scale, atol=3e-7)
    # A sphere that grows moves the image along the camera's ray.
    across = rows[0, -1] * along[1] - rows[1, -1] * along[0]
    assert abs(across) < 1e-9 * np.linalg.norm(rows[:, -1]) * np.linalg.norm(along)


@pytest.mark.parametrize("offset", [(40.0, 1.0, 0.0), (0.0, 31.0, -2.0)])
def test_a_ray_that_misses_the_sphere_has_derivatives_too(offset: tuple[float, float, float]) -> None:
    pose = POSES[0]
    u = SPHERE[:3] + np.array(offset) - pose.centre()
    c, by = SPHERE[:3] - pose.centre(), np.empty((3, 3))

    def along(p: Floats) -> Floats:
        s, _ = meet_sphere(p[:3].copy(), p[3:6].copy(), p[6], FLATTEST, np.empty((3, 3)))
        return np.array([s])

    _, cosine = meet_sphere(c, u, 30.0, FLATTEST, by)
    assert cosine == 0.0
    wanted = slopes(along, np.concatenate([c, u, [30.0]]), np.full(7, 1e-2))[0]
    # Values near 1 have rounding of 1e-15; divided by the step and grown by the clamp, 1e-11.
    np.testing.assert_allclose(np.concatenate([by[0], by[1], by[2, :1]]), wanted, atol=1e-9)


def test_the_root_of_a_grazing_ray_goes_on_smoothly() -> None:
    # On both sides of the limit value and slope are the same.
    c = np.array([0.0, 0.0, 1000.0])
    edge = 30.0 * np.sqrt(1.0 - FLATTEST**2) / 1000.0
    found = []
    for off in (-1e-9, 1e-9):
        by = np.empty((3, 3))
        tangent = (edge + off) / np.sqrt(1.0 - edge**2)
        s, _ = meet_sphere(c, np.array([tangent, 0.0, 1.0]), 30.0, FLATTEST, by)
        found.append([s, *by.ravel()[:7]])
    # The slopes change by their own derivative times 2e-9: 300 per unit over a clamp of 0.1 squared.
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4)


def test_board_derivatives_are_finite_differences() -> None:
    point = np.array([120.0, -80.0, 0.0, 0.7, -0.2, -0.5])
    shape = np.array([0.3, -2.0, 1.0])
    base = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix()

    def board(change: Floats) -> Floats:
        found = np.zeros((3, 6))
        found[:, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ base
        found[:, 3] = np.array([5.0, -10.0, 20.0]) + change[3:6]
        found[0, 4], found[:, 5] = 1.0 + change[6], shape + change[7:]
        return found

    def predicted(parameters: Floats) -> Floats:
        both = np.stack([parameters[:PER_SENSOR], SENSORS[1]])
        rotation, translation, lens = (a[0] for a in arrays(both))
        out = np.empty(2)
        board_rows(
            rotation,
            translation,
            lens,
            board(parameters[PER_SENSOR:]),
            point,
            out,
            np.zeros((2, BOARD_SIZE)),
            np.zeros((2, 3)),
        )
        return out

    rows, slope, pixel = np.zeros((2, BOARD_SIZE)), np.zeros((2, 3)), np.empty(2)
    rotation, translation, lens = (a[0] for a in arrays(SENSORS))
    assert board_rows(rotation, translation, lens, board(np.zeros(10)), point, pixel, rows, slope)
    placed = board(np.zeros(10))
    world = placed[:, :3] @ (point[:3] + np.array([0.0, 0.0, shape @ point[3:]])) + placed[:, 3]
    model = camera_models(SENSORS)[0]
    np.testing.assert_allclose(pixel, project(*model, world[None])[0], rtol=1e-12)
    np.testing.assert_allclose(slope, projection_jacobian(*model, world[None])[0], rtol=1e-10)
    at = np.concatenate([SENSORS[0], np.zeros(10)])
    wanted = slopes(predicted, at, np.concatenate([STEPS, [1e-4] * 3, [0.1] * 3, [1e-4], [0.1] * 3]))
    scale = np.abs(wanted).max(axis=0) + 1e-3
    # As for spheres.
    np.testing.assert_allclose(rows / scale, wanted / scale, atol=1e-8)


def test_gap_and_place_change_as_finite_differences(rng: np.random.Generator) -> None:
    base, u, v = np.array([1.0, 0.1, -0.2]), np.array([0.3, 0.02, 1.0]), np.array([-0.4, 0.05, 1.1])
    by_gap, by_along = np.empty((3, 3)), np.empty((3, 3))
    gap = gap_change(u, v, base, by_gap)
    along = along_change(u, v, base, by_along)
    # The nearest points of the rays are apart by the gap, along both normals.
    n = np.cross(u, v)
    t = np.dot(np.cross(base, u), n) / np.dot(n, n)
    np.testing.assert_allclose(base + t * v - along * u, gap * n / np.linalg.norm(n), atol=1e-14)

    def both(p: Floats) -> Floats:
        b, a, c = (np.ascontiguousarray(x) for x in p.reshape(3, 3))
        return np.array([gap_change(a, c, b, np.empty((3, 3))), along_change(a, c, b, np.empty((3, 3)))])

    wanted = slopes(both, np.concatenate([base, u, v]), np.full(9, 1e-3))
    # Truncation of order h^4 with derivatives of order 10 and rounding 1e-16 / 1e-3.
    np.testing.assert_allclose(by_gap.ravel(), wanted[0], atol=1e-9)
    np.testing.assert_allclose(by_along.ravel(), wanted[1], atol=1e-9)


def test_distances_are_those_of_a_plain_triangulation() -> None:
    camera, projector = camera_models(SENSORS)
    pixels = np.stack([seen_pixel((-5.0, 8.0, 26.0)), np.array([534.0, 401.0])])
    u = ray_directions(*camera, pixels[:1])[0]
    v = ray_directions(*projector, pixels[1:])[0]
    base = projector[1].centre() - camera[1].centre()
    # Both rays' nearest points by least squares over s u - t v = base.
    (s, t), *_ = np.linalg.lstsq(np.stack([u, -v], axis=1), base, rcond=None)
    point = camera[1].centre() + s * u
    gap = np.linalg.norm(projector[1].centre() + t * v - point)
    found = ray_distances(*arrays(SENSORS), (0, 1), pixels, SPHERE)
    # Coordinates of a metre have rounding of 1e-13 mm, grown by the angle of the rays.
    assert abs(found[0]) == pytest.approx(gap, abs=1e-10)
    assert found[1] == pytest.approx(np.linalg.norm(point - SPHERE[:3]) - SPHERE[3], abs=1e-10)


def test_the_way_in_the_projector_is_gap_and_surface_residual_whitened(rng: np.random.Generator) -> None:
    # w = A^-1 (epsilon_1, epsilon_2) to first order, A being their derivatives by the projector's pixel.
    camera_px = seen_pixel((-5.0, 8.0, 26.0))
    pixel = np.empty(2)
    rotation, translation, lens = arrays(SENSORS)
    sphere_rows(
        rotation,
        translation,
        lens,
        (0, 1),
        camera_px,
        SPHERE,
        FLATTEST,
        pixel,
        np.zeros((2, SPHERE_SIZE)),
        np.empty(2),
        room_of_sphere(),
    )

    def distances(projector_px: Floats) -> Floats:
        pixels = np.stack([camera_px, projector_px])
        return np.array(ray_distances(rotation, translation, lens, (0, 1), pixels, SPHERE))

    # Rays have rounding of 1e-13 mm.
    np.testing.assert_allclose(distances(pixel), 0.0, atol=1e-9)
    a = slopes(distances, pixel, np.full(2, 0.01))
    for _ in range(5):
        noise = 0.01 * rng.standard_normal(2)
        # The second order is (mm per px)^2 over the radius: 1 % of 1 mm over 30 mm.
        np.testing.assert_allclose(np.linalg.solve(a, distances(pixel + noise)), noise, atol=2e-3 * 0.01)


def test_points_move_with_the_sensors_as_finite_differences() -> None:
    points = np.array([[0.0, 0.0, 0.0], [120.0, -80.0, 60.0]])
    camera, projector = camera_models(SENSORS)
    pixels = [project(*camera, points), project(*projector, points)]

    def triangulated(parameters: Floats) -> Floats:
        (ci, cp), (pi, pp) = camera_models(parameters.reshape(2, PER_SENSOR))
        u, v = ray_directions(ci, cp, pixels[0]), ray_directions(pi, pp, pixels[1])
        base, n = pp.centre() - cp.centre(), np.cross(u, v)
        along = np.sum(np.cross(base, v) * n, axis=1) / np.sum(n * n, axis=1)
        return np.asarray(cp.centre() + along[:, None] * u)

    wanted = slopes(triangulated, SENSORS.ravel(), np.concatenate([STEPS, STEPS]))
    found = point_jacobian(camera, projector, points)
    scale = np.abs(wanted).max(axis=(0, 1)) + 1e-3
    # As for spheres, in mm; the differences are taken of coordinates of a metre.
    np.testing.assert_allclose(found / scale, wanted / scale, atol=1e-7)
