"""By how much rays miss each other because a calibration is not exact."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.calibration.checking.expected_gap import expected_gap_px, pixel_size
from sms_jobs.metrology.calibration.pair_points import Parameters, meet_rays, moved_sensor
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics

DOWN = np.array([0.0, -1.0, 0.0])
CAMERA: Parameters = (
    Intrinsics(1500.0, 1500.0, 511.5, 383.5, -0.1, 0.05),
    Pose.looking_at(np.array([-300.0, 0.0, -1000.0]), np.zeros(3), DOWN),
)
PROJECTOR: Parameters = (
    Intrinsics(1400.0, 1405.0, 500.0, 420.0, 0.05, -0.02),
    Pose.looking_at(np.array([300.0, 50.0, -1050.0]), np.zeros(3), DOWN),
)


def test_a_pixel_has_the_width_that_its_rays_span() -> None:
    points = np.array([[0.0, 0.0, 0.0], [50.0, -20.0, 100.0]])
    size = pixel_size(CAMERA, points)
    along = CAMERA[1].matrix()[0]
    moved = project(*CAMERA, points + size[:, None] * along)
    # But for distortion, a thousandth so near the axis.
    np.testing.assert_allclose(moved[:, 0] - project(*CAMERA, points)[:, 0], 1.0, rtol=0.02)


def test_the_gap_scatters_as_the_calibration_says(rng: np.random.Generator) -> None:
    points = rng.uniform(-100.0, 100.0, (20, 3))
    # Turns of 20 urad, shifts of 20 um, focal lengths and principal points of 0.1 px, no distortion.
    each = np.concatenate([np.full(3, 2e-5), np.full(3, 0.02), np.full(4, 0.1), np.zeros(PER_SENSOR - 10)])
    sigma = np.tile(each, 2)
    expected = expected_gap_px(CAMERA, PROJECTOR, np.diag(sigma**2), points)
    pixels = project(*CAMERA, points), project(*PROJECTOR, points)
    draws = 1000
    squares = 0.0
    for step in sigma * rng.standard_normal((draws, 2 * PER_SENSOR)):
        sensors = moved_sensor(CAMERA, step[:PER_SENSOR]), moved_sensor(PROJECTOR, step[PER_SENSOR:])
        _, gap = meet_rays(*sensors, *pixels)
        squares += np.mean(np.square(gap / pixel_size(PROJECTOR, points)))
    # A few combinations of parameters make nearly all of it: a standard deviation of 1000 draws is good to
    # 1 / sqrt(2 x 1000), 2 %; four times that.
    assert np.sqrt(squares / draws) == pytest.approx(expected, rel=0.09)


def test_points_behind_a_sensor_do_not_count() -> None:
    covariance = np.eye(2 * PER_SENSOR) * 1e-8
    before, behind = np.zeros((1, 3)), np.array([[0.0, 0.0, -5000.0]])
    alone = expected_gap_px(CAMERA, PROJECTOR, covariance, before)
    assert expected_gap_px(CAMERA, PROJECTOR, covariance, np.concatenate([before, behind])) == alone
    assert expected_gap_px(CAMERA, PROJECTOR, covariance, behind) == 0.0
