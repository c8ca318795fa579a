"""Calibration sessions on the virtual rig for tests: a small one, and one that recalibrates on site."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from math import pi

import numpy as np

from sms_jobs.records.artefacts import BallBar, CircleBoard, DotCylinder
from sms_jobs.records.campaign import CalibrationSession, Campaign, LoadState, Specimen
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, Rigid, Scene, Vector
from sms_jobs.records.sensors import Box, Rig, Sensor, SensorFormat
from sms_jobs.records.views import Role
from sms_jobs.virtual_rig.campaigns import (
    BENDING_PROJECTOR,
    BENDING_VOLUME,
    START,
    Lens,
    Size,
    aimed,
    bending_rig,
)
from sms_jobs.virtual_rig.sessions import (
    BAR,
    BOARD,
    BOARD_POSES,
    POSE_TIME,
    BoardPose,
    bar_states,
    board_states,
    session_of,
    tripod_at,
)

SITE_POSES: tuple[BoardPose, ...] = (
    *BOARD_POSES,
    (5.0, (-12.0, 6.0), (15.0, 10.0, -130.0)),
    (-6.0, (11.0, -7.0), (-25.0, -15.0, -30.0)),
    (92.0, (-17.0, 3.0), (10.0, -10.0, 30.0)),
    (-90.0, (5.0, -10.0), (-15.0, 10.0, -90.0)),
    (8.0, (15.0, 8.0), (15.0, -15.0, 60.0)),
    (-9.0, (-9.0, 9.0), (0.0, 15.0, -20.0)),
    (182.0, (8.0, -3.0), (10.0, -15.0, -110.0)),
    (6.0, (-14.0, -9.0), (-15.0, 0.0, 100.0)),
    (-4.0, (18.0, 0.0), (0.0, -15.0, 20.0)),
)
SMALL_BOARD = CircleBoard(
    *(7, 7, 30.0, 18.0, ((1, 1), (5, 1), (1, 5)), "ring", 24.0, 12.0),
    pitch_relative_sigma=1e-3,
    flatness_mm=0.05,
)
SMALL_BAR = BallBar(190.0, 0.005, 22.0, 0.002, stalk_mm=30.0, slide_mm=6.0)
SMALL_ANGLES_DEG = (
    (0.0, 0.0), (40.0, 0.0), (0.0, 40.0), (-40.0, -35.0), (35.0, -40.0), (-35.0, 35.0)
)  # fmt: skip


def on_site_session(name: str, size: Size, rig: Rig | None = None) -> Campaign:
    """Return a recalibration of the rig of `top_hat_bending` from 15 board poses, an hour before campaigns.

    States B01 .. B15; it starts from the last calibration. Parameters as in `calibration_session`.
    """
    begin = START - timedelta(hours=1)
    states = board_states(BOARD, SITE_POSES)
    made = session_of(name, rig or bending_rig(size), states, (BOARD, BAR), BENDING_VOLUME)
    assert made.session is not None
    assert made.scene is not None
    timed = (replace(s, time=begin + number * POSE_TIME) for number, s in enumerate(made.states))
    return replace(
        made,
        states=tuple(timed),
        # Noise of its own.
        scene=replace(made.scene, seed=2),
        session=replace(made.session, artefacts={"board": BOARD}, starts_from="last-calibration"),
    )


def small_session(name: str) -> Campaign:
    """Return a session that is recorded in seconds: one camera of 256 px, two projectors, 3 + 6 poses."""
    sensors = (
        aimed("C1", 256, 256, Lens(3.85, -0.08, 0.12, 2e-4, -3e-4), (-200.0, 80.0, 1230.0), 0.02),
        aimed("P1", 512, 384, Lens(3.0, -0.05, 0.1, 1e-4, 2e-4), (450.0, -100.0, 1150.0)),
        aimed("P2", 512, 384, Lens(3.0, -0.04, 0.1, -1e-4, 1e-4), (-750.0, 150.0, 1000.0)),
    )
    poses: tuple[BoardPose, ...] = (
        (0.0, (0.0, 0.0), (0.0, 0.0, 0.0)),
        (10.0, (20.0, -8.0), (10.0, -8.0, -50.0)),
        (85.0, (-15.0, 15.0), (-8.0, 10.0, 45.0)),
    )
    states = [
        *board_states(SMALL_BOARD, poses),
        *bar_states(SMALL_ANGLES_DEG, tripod_at((-3.0, -20.0, 0.0), (0.02, 0.03, -0.01))),
    ]
    volume = Box((-130.0, -130.0, -130.0), (130.0, 130.0, 130.0))
    return session_of(name, Rig("small-session-rig", sensors), states, (SMALL_BOARD, SMALL_BAR), volume)


TUBE = DotCylinder(
    *(40, 13, 6.0, 3.3, 80.0, ((18, 4), (22, 4), (18, 8)), "ring", 4.2, 1.8),
    diameter_sigma_mm=0.1,
)


def cylinder_session(
    name: str, sensors: tuple[Sensor, ...], turns_rad: tuple[Vector, ...], tube: DotCylinder = TUBE
) -> Campaign:
    """Return a session of a cylinder that stands upright about the world's origin, turned in each pose.

    States B01, ...; the first marker faces the sensors, at +Z, where no turn says otherwise. Every camera is
    a view with each projector, or alone.
    """
    rig = Rig(f"{name}-rig", sensors)
    home = Rigid((pi, 0.0, 0.0), (0.0, 2.0 * tube.pitch_mm, 0.5 * tube.diameter_mm))
    shifts = np.random.default_rng(11).uniform(-1.0, 1.0, (len(turns_rad), 3)) * [12.0, 8.0, 25.0]
    shifts[0] = 0.0
    states = tuple(
        LoadState(
            f"B{number:02d}",
            time=START + number * POSE_TIME,
            deformation=(home, Rigid(turn, (float(x), float(y), float(z)))),
            artefact="tube",
        )
        for number, (turn, (x, y, z)) in enumerate(zip(turns_rad, shifts, strict=True), start=1)
    )
    session = CalibrationSession(
        {"tube": tube},
        tuple(SensorFormat(s.name, s.columns, s.rows) for s in sensors),
        Box((-40.0, -40.0, -20.0), (40.0, 40.0, 50.0)),
        home,
    )
    scene = Scene(rig, tube, camera=CameraResponse(exposure=0.75), projector=BENDING_PROJECTOR, seed=4)
    projectors = [s.name for s in sensors if s.role is Role.PROJECTOR]
    cameras = [s.name for s in sensors if s.role is Role.CAMERA]
    views = tuple(c + p for c in cameras for p in projectors or ("",))
    return Campaign(name, Specimen("tube"), rig.name, states, views, FringeSequence(), scene, session=session)
