"""Sensor parameters of the thesis: their equations, their way into the camera model and back."""

from __future__ import annotations

from dataclasses import replace
from math import pi, radians

import numpy as np
import pytest

from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.thesis_parameters import (
    ImagePlane,
    ThesisParameters,
    angles_from_rotation,
    distortion_correction,
    normalised_from_plane,
    pixels_from_plane,
    plane_from_pixels,
    pose_from_thesis,
    sensor_from_thesis,
    thesis_from_sensor,
)
from sms_jobs.metrology.geometry.transforms import rotation_from_angles
from sms_jobs.metrology.phase.patterns import phase_gradient

CHIP = ImagePlane((8.71, 6.97), (1300, 1040))  # pixels of 6.7 micrometres
SENSOR = ThesisParameters(
    0.05, -0.12, 26.2, 2.3e-4, -1.1e-7, 4e-11, 0.05, 0.59, -0.02, (480.0, -35.0, -1100.0)
)


def test_a_pixel_is_one_nth_of_the_chip() -> None:
    corners = np.array([[-0.5, -0.5], [1299.5, 1039.5]])
    # The outer edges of the outermost pixels are the edges of the chip; rounding only.
    np.testing.assert_allclose(
        plane_from_pixels(CHIP, corners), [[-4.355, -3.485], [4.355, 3.485]], rtol=1e-14
    )
    step = plane_from_pixels(CHIP, np.array([[8.0, 8.0]])) - plane_from_pixels(CHIP, np.array([[7.0, 7.0]]))
    np.testing.assert_allclose(
        step, [[8.71 / 1300, 6.97 / 1040]], rtol=1e-11
    )  # a difference of nearly equals


def test_the_printed_equation_puts_the_outermost_pixel_centres_at_the_edge() -> None:
    printed = replace(CHIP, pitch="L/(N-1)")
    first_and_last = np.array([[0.0, 0.0], [1299.0, 1039.0]])
    np.testing.assert_allclose(
        plane_from_pixels(printed, first_and_last), [[-4.355, -3.485], [4.355, 3.485]], rtol=1e-14
    )


@pytest.mark.parametrize("pitch", ["L/N", "L/(N-1)"])
def test_pixels_come_back_from_the_plane(pitch: str, rng: np.random.Generator) -> None:
    plane = ImagePlane((8.71, 6.97), (1300, 1040), "L/N" if pitch == "L/N" else "L/(N-1)")
    pixels = rng.uniform(0.0, 1000.0, (50, 2))
    # Rounding of numbers up to 1300.
    np.testing.assert_allclose(
        pixels_from_plane(plane, plane_from_pixels(plane, pixels)), pixels, atol=1e-12 * 1300
    )


def test_a_projectors_phase_and_its_pixels_meet_in_the_plane() -> None:
    plane = ImagePlane((13.0, 9.8), (1024, 768))
    pixels = np.array([[0.0, 0.0], [17.0, 400.0], [1023.0, 767.0]])
    omega = np.stack([phase_gradient(pixels, 1024, 768, a) for a in (0.0, pi / 2)], axis=-1)
    by_pixels = plane_from_pixels(plane, pixels)
    # Thesis Eq. (1.20), xi = omega L / (2 pi); rounding of millimetres: both ways are (x + 1/2 - N/2) L / N.
    np.testing.assert_allclose(omega / (2.0 * pi) * plane.length_mm, by_pixels, atol=1e-13)


def test_angles_come_back_from_the_rotation(rng: np.random.Generator) -> None:
    for omega, phi, kappa in rng.uniform([-pi, -pi / 2, -pi], [pi, pi / 2, pi], (200, 3)):
        # Angles are defined up to 1 / cos(phi) roundings; the least cos(phi) of these draws is above 1e-3.
        found = angles_from_rotation(rotation_from_angles(omega, phi, kappa))
        np.testing.assert_allclose(found, (omega, phi, kappa), atol=1e-12)


@pytest.mark.parametrize("phi", [pi / 2, -pi / 2])
def test_a_quarter_turn_of_phi_still_gives_the_same_rotation(phi: float) -> None:
    rotation = rotation_from_angles(0.3, phi, 0.8)
    omega, found, kappa = angles_from_rotation(rotation)
    assert kappa == 0.0
    # cos(pi / 2) is 6e-17, and one rounding of each element.
    np.testing.assert_allclose(rotation_from_angles(omega, found, kappa), rotation, atol=1e-15 * 4)


def test_the_pin_hole_is_where_the_thesis_says() -> None:
    # Rounding of a product of rotation and metres.
    np.testing.assert_allclose(pose_from_thesis(SENSOR).centre(), SENSOR.pin_hole, atol=1e-12 * 1100)


def test_the_distortion_correction_is_radial_and_counts_from_the_principal_point() -> None:
    at_principal = np.array([SENSOR.xi_h, SENSOR.eta_h])
    assert not distortion_correction(SENSOR, at_principal).any()
    shift = distortion_correction(SENSOR, at_principal + np.array([3.0, 4.0]))
    # r = 5 mm: (3, 4) (k1 25 + k2 625 + k3 15625), by hand.
    np.testing.assert_allclose(
        shift, np.array([3.0, 4.0]) * (2.3e-4 * 25 - 1.1e-7 * 625 + 4e-11 * 15625), rtol=1e-12
    )


def test_the_measured_point_is_the_ideal_one_with_the_correction_added() -> None:
    points = plane_from_pixels(CHIP, np.array([[0.0, 0.0], [1000.0, 200.0]]))
    rays = normalised_from_plane(SENSOR, points)
    again = SENSOR.c * rays + [SENSOR.xi_h, SENSOR.eta_h] + distortion_correction(SENSOR, points)
    np.testing.assert_allclose(again, points, atol=1e-14 * 10)  # Eq. (1.21) as it is printed; rounding


def test_the_camera_model_sees_what_the_thesis_sees(rng: np.random.Generator) -> None:
    intrinsics, pose, misfit = sensor_from_thesis(SENSOR, CHIP)
    pixels = rng.uniform(0.0, 1.0, (200, 2)) * [1299.0, 1039.0]
    rays = normalised_from_plane(SENSOR, plane_from_pixels(CHIP, pixels))
    inside = np.concatenate([rays, np.ones((200, 1))], axis=1) * 1200.0
    world = (inside - pose.translation) @ pose.matrix()
    # The conversion says by how much it is off at most; rounding of the rest is far below.
    assert np.abs(project(intrinsics, pose, world) - pixels).max() <= 1.05 * misfit.largest_px + 1e-9
    assert (
        misfit.largest_px < 1e-4
    )  # a lens of 0.9 % distortion at the corner loses nothing that can be measured
    assert misfit.rms_px <= misfit.largest_px


def test_without_distortion_the_conversion_is_exact() -> None:
    straight = replace(SENSOR, k1=0.0, k2=0.0, k3=0.0)
    intrinsics, pose, misfit = sensor_from_thesis(straight, CHIP)
    assert misfit.largest_px == 0.0
    back, plane, _ = thesis_from_sensor(intrinsics, pose, CHIP.pixels, 0.0067)
    np.testing.assert_allclose(plane.length_mm, CHIP.length_mm, rtol=1e-12)
    np.testing.assert_allclose(
        [back.xi_h, back.eta_h, back.c, back.omega, back.phi, back.kappa, *back.pin_hole],
        [SENSOR.xi_h, SENSOR.eta_h, SENSOR.c, SENSOR.omega, SENSOR.phi, SENSOR.kappa, *SENSOR.pin_hole],
        rtol=1e-10,  # xi_H is a difference of numbers a hundred times as large
    )


def test_a_sensor_comes_back_from_the_thesis_to_the_misfit(rng: np.random.Generator) -> None:
    camera = Intrinsics(3912.15, 3905.0, 508.665, 562.773, -0.084, 0.31, 0.0, 0.0, 0.2)
    pose = Pose.looking_at(np.array([-300.0, 40.0, -1500.0]), np.zeros(3), np.array([0.0, -1.0, 0.1]))
    parameters, plane, out = thesis_from_sensor(camera, pose, (1024, 1024), 0.0067)
    again, same_pose, back = sensor_from_thesis(parameters, plane)
    assert (again.fx, again.cx) == pytest.approx((camera.fx, camera.cx), rel=1e-12)
    assert (again.fy, again.cy) == pytest.approx((camera.fy, camera.cy), rel=1e-12)
    pixels = rng.uniform(0.0, 1023.0, (100, 2))
    off = ray_directions(again, same_pose, pixels) - ray_directions(camera, pose, pixels)
    # An angle of 1 / fx is a pixel; the two misfits add at most.
    assert np.abs(off).max() * camera.fx <= 1.05 * (out.largest_px + back.largest_px) + 1e-9


def test_tangential_distortion_is_left_over_and_stated() -> None:
    pose = Pose.looking_at(np.array([0.0, 0.0, -1000.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    decentred = Intrinsics(2000.0, 2000.0, 639.5, 511.5, 0.0, 0.0, 1e-3, 0.0, 0.0)
    _, _, misfit = thesis_from_sensor(decentred, pose, (1280, 1024), 0.005)
    # p1 (r^2 + 2 y^2) f at the corner: r = 0.41, y = 0.256 in units of f, so 0.6 px; no radial term helps.
    assert 0.3 < misfit.largest_px < 0.7


def test_the_cameras_of_table_4() -> None:
    # Thesis Table 4, proposed system, with the 6.7 um pixels of its camera; its kappa_1 = 0.001 is in units
    # of the focal length, as in the camera model here, and its principal point counts pixels.
    pitch = 0.0067
    for (cx, cy), f in (((508.665, 562.773), 3912.15), ((522.480, 566.328), 3894.97)):
        camera = Intrinsics(f, f, cx, cy, 0.001)
        pose = Pose.from_arrays(
            rotation_from_angles(radians(0.603), radians(33.972), radians(-1.157)), np.zeros(3)
        )
        parameters, plane, misfit = thesis_from_sensor(camera, pose, (1024, 1024), pitch)
        assert parameters.c == pytest.approx(f * pitch)  # 26.2 mm
        assert parameters.xi_h == pytest.approx((cx - 511.5) * pitch)
        assert parameters.eta_h == pytest.approx((cy - 511.5) * pitch)
        # To first order the two distortions are the same with k1 = kappa_1 / c^2; the rest is of second
        # order, kappa_1 r^2 = 4e-5 of it.
        assert parameters.k1 == pytest.approx(0.001 / parameters.c**2, rel=1e-3)
        assert misfit.largest_px < 1e-6
        again, _, _ = sensor_from_thesis(parameters, plane)
        assert again.fx == pytest.approx(f, rel=1e-13)
        assert again.k1 == pytest.approx(0.001, rel=1e-6)
