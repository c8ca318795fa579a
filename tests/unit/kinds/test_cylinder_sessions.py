"""Calibration from a cylinder of dots, as its jobs do it from rendered pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.calibration_sessions import SessionInMemory
from support.sessions import TUBE, cylinder_session

from sms_jobs.kinds.calibration import calibrate_boards, observe_board
from sms_jobs.kinds.calibration.sessions import board_states, every_view
from sms_jobs.metrology.calibration.estimates import Estimated
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR
from sms_jobs.records.scene import Vector
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, PROJECTOR_LENS, aimed

TURNS: tuple[Vector, ...] = ((0.0, 0.0, 0.0), (0.4, 0.1, 0.2), (-0.3, 0.2, 1.3))
CAMERA = aimed("C1", 480, 480, CAMERA_LENS, (-40.0, 10.0, 430.0))


def observed(sensors: tuple[Sensor, ...], turns: tuple[Vector, ...]) -> SessionInMemory:
    """Return a session that was rendered, and what its views saw of the cylinder."""
    made = SessionInMemory(cylinder_session("tubes", sensors, turns))
    for state in made.campaign.states:
        made.record(state.label)
    for subject in every_view(made.campaign, board_states(made.campaign)):
        made.run(observe_board, subject, threads=1)
    return made


@pytest.fixture(scope="module")
def alone() -> SessionInMemory:
    """A camera alone, three poses."""
    return observed((CAMERA,), TURNS)


def calibrated(made: SessionInMemory) -> dict[str, object]:
    """Return the records of the calibration."""
    return dict(made.run(calibrate_boards, Subject("tubes"), threads=1, folds=2, figure_width_px=400))


def parameter_z(made: SessionInMemory) -> np.ndarray:
    """Return errors of all free parameters of lenses over their stated deviations."""
    found = made.records["calibrate-boards", "tubes"]
    scene = made.campaign.scene
    assert scene is not None
    z = []
    deviation = np.sqrt(np.diag(found["uncertainty"].covariance)).reshape(-1, PER_SENSOR)[:, PER_POSE:]
    for true, sensor, stated in zip(
        scene.rig.sensors, found["calibration"].rig.sensors, deviation, strict=True
    ):
        off = sensor.intrinsics.vector() - true.intrinsics.vector()
        z.append(off[stated > 0.0] / stated[stated > 0.0])
    return np.concatenate(z)


def test_a_camera_alone_is_calibrated_by_a_cylinder(alone: SessionInMemory) -> None:
    made = alone.copy()
    calibrated(made)
    quality = made.records["calibrate-boards", "tubes"]["quality"]
    diameter = quality.estimate(Estimated.DIAMETER, "tube")
    assert diameter.sigma < 0.01
    # The dots are exactly where they should be: what is stated covers their 0.002 mm besides noise.
    assert abs(diameter.value - TUBE.diameter_mm) < 3.0 * diameter.sigma
    z = parameter_z(made)
    assert len(z) == 8
    assert np.abs(z).max() < 3.0
    assert quality.warnings == ()


def test_a_wrong_diameter_is_not_certified(alone: SessionInMemory) -> None:
    made = alone.copy()
    session = made.campaign.session
    assert session is not None
    wrong = replace(TUBE, diameter_mm=1.05 * TUBE.diameter_mm)
    made.campaign = replace(made.campaign, session=replace(session, artefacts={"tube": wrong}))
    calibrated(made)
    quality = made.records["calibrate-boards", "tubes"]["quality"]
    assert any("the diameter of tube is stated as 84 mm within 0.1 mm" in one for one in quality.warnings)


def test_a_projector_is_calibrated_by_a_cylinder() -> None:
    projector = aimed("P1", 512, 384, PROJECTOR_LENS, (110.0, -20.0, 400.0))
    made = observed((CAMERA, projector), TURNS)
    calibrated(made)
    found = made.records["calibrate-boards", "tubes"]
    quality, scene = found["quality"], made.campaign.scene
    assert scene is not None
    z = parameter_z(made)
    assert len(z) == 16
    # 16 correlated numbers: none beyond 4.5 of their deviations.
    assert np.abs(z).max() < 4.5
    diameter = quality.estimate(Estimated.DIAMETER, "tube")
    assert abs(diameter.value - TUBE.diameter_mm) < 4.5 * diameter.sigma
    covariance = found["uncertainty"].covariance
    for k, (true, sensor) in enumerate(zip(scene.rig.sensors, found["calibration"].rig.sensors, strict=True)):
        off = np.subtract(sensor.pose.translation, true.pose.translation)
        own = np.sqrt(np.diag(covariance)[PER_SENSOR * k + 3 : PER_SENSOR * k + 6])
        assert np.abs(off / own).max() < 4.5
    assert quality.warnings == ()
