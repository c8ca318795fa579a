"""Calibration sessions on the virtual rig: poses of a board and of a ball bar on a pan-tilt stage."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import timedelta
from math import pi, radians
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.records.artefacts import BallBar, CircleBoard
from sms_jobs.records.campaign import CalibrationSession, Campaign, LoadState, Specimen
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, PanTilt, Rigid, Scene, Vector
from sms_jobs.records.sensors import Box, Rig, SensorFormat
from sms_jobs.virtual_rig.artefacts import board_points
from sms_jobs.virtual_rig.campaigns import (
    BENDING_PROJECTOR,
    BENDING_VOLUME,
    START,
    Size,
    bending_rig,
)

BEGIN = START - timedelta(days=1)
"""Of a session: what it finds is valid before the campaigns of the virtual rig begin."""
POSE_TIME = timedelta(seconds=36)
"""To position an artefact and record it (thesis section 3.4)."""

EXPOSURE = 0.75
"""Of every camera: the nearest sphere stays below full scale."""

BoardPose: TypeAlias = tuple[float, tuple[float, float], Vector]
"""From facing the rig at the origin: turned in its plane, then tilted about X and Y (degrees), moved (mm)."""

BOARD = CircleBoard(
    *(15, 15, 30.0, 18.0, ((3, 3), (11, 3), (3, 11)), "ring", 24.0, 12.0),
    pitch_relative_sigma=1e-3,
    flatness_mm=0.05,
)
BAR = BallBar(480.0, 0.005, 25.0, 0.002, stalk_mm=50.0, slide_mm=15.0)
BOARD_POSES: tuple[BoardPose, ...] = (
    (0.0, (0.0, 0.0), (0.0, 0.0, 0.0)),
    (4.0, (18.0, 3.0), (0.0, 0.0, -100.0)),
    (-10.0, (-16.0, -5.0), (-10.0, 15.0, 90.0)),
    (90.0, (4.0, 10.0), (20.0, 5.0, 50.0)),
    (6.0, (-7.0, -10.0), (-15.0, -10.0, -60.0)),
    (180.0, (13.0, -8.0), (0.0, 0.0, 110.0)),
)
TABLE_ANGLES_DEG = tuple(
    (pan, tilt)
    for number, tilt in enumerate((-45.0, -22.5, 0.0, 22.5, 45.0))
    for pan in (-45.0, -22.5, 0.0, 22.5, 45.0)[:: -1 if number % 2 else 1]
)
"""Pan and tilt of the 25 poses of thesis Table 3, in its order; its 315 degrees are -45 here."""

TRIPOD_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The tripod's axes in the world, as columns: x, the pan axis, up; z, the bar at home, along X."""


def calibration_session(name: str, size: Size, rig: Rig | None = None) -> Campaign:
    """Return the calibration of the rig of `top_hat_bending`: 6 board poses and the 25 bar poses of Table 3.

    States B01 .. B06 and S01 .. S25. The first board faces the rig with its middle at the world's origin;
    `CalibrationSession.board_in_world` says so, so that a calibration comes out in the world of the campaign.

    Parameters
    ----------
    name
        Of the session.
    size
        Of the cameras, as in `bending_rig`.
    rig
        As it truly stands; by default that of `bending_rig`.
    """
    tripod = tripod_at((-5.0, -35.0, 0.0), (0.03, -0.02, 0.015))
    states = [
        *board_states(BOARD, BOARD_POSES),
        *bar_states(TABLE_ANGLES_DEG, tripod),
    ]
    return session_of(name, rig or bending_rig(size), states, (BOARD, BAR), BENDING_VOLUME)


def facing_rig(board: CircleBoard) -> Rigid:
    """Return what stands a board upright in the world, its middle at the origin, its front to the sensors.

    For a board whose x runs to the right and y down; the world's Y is up, and the sensors are at +Z.
    """
    _, points = board_points(board)
    x, y, _ = points.mean(axis=0)
    return Rigid((pi, 0.0, 0.0), (-float(x), float(y), 0.0))


def tripod_at(origin_mm: Vector, lean_rad: Vector) -> Rigid:
    """Return what brings the tripod's frame into the world, leaning a little."""
    return _rigid(Rotation.from_rotvec(lean_rad) * Rotation.from_matrix(TRIPOD_AXES), origin_mm)


def _rigid(rotation: Rotation, translation_mm: Vector) -> Rigid:
    x, y, z = rotation.as_rotvec()
    return Rigid((float(x), float(y), float(z)), translation_mm)


def board_states(board: CircleBoard, poses: Iterable[BoardPose]) -> list[LoadState]:
    """Return states B01, B02, ... of a board in some poses."""
    states = []
    for number, (turn, (tilt_x, tilt_y), shift) in enumerate(poses, start=1):
        turned = Rotation.from_rotvec([tilt_x, tilt_y, 0.0], degrees=True) * Rotation.from_rotvec(
            [0.0, 0.0, turn], degrees=True
        )
        deformation = (facing_rig(board), _rigid(turned, shift))
        states.append(LoadState(f"B{number:02d}", deformation=deformation, artefact="board"))
    return states


def bar_states(angles_deg: Iterable[tuple[float, float]], tripod: Rigid) -> list[LoadState]:
    """Return states S01, S02, ... of a bar on a tripod at some angles of pan and tilt."""
    states = []
    for number, (pan, tilt) in enumerate(angles_deg, start=1):
        stage = PanTilt(radians(pan), radians(tilt))
        channels = {"pan_rad": stage.pan_rad, "tilt_rad": stage.tilt_rad}
        states.append(
            LoadState(f"S{number:02d}", channels=channels, deformation=(stage, tripod), artefact="bar")
        )
    return states


def session_of(
    name: str, rig: Rig, states: list[LoadState], artefacts: tuple[CircleBoard, BallBar], volume: Box
) -> Campaign:
    """Return a session of a board and a bar, whose poses are recorded one after the other from `BEGIN` on."""
    board, bar = artefacts
    timed = tuple(replace(s, time=BEGIN + number * POSE_TIME) for number, s in enumerate(states))
    scene = Scene(
        rig,
        board,
        camera=CameraResponse(exposure=EXPOSURE),
        projector=BENDING_PROJECTOR,
        # Noise of its own: states of tests and of other sessions have the same labels, and the seed 0.
        seed=1,
    )
    session = CalibrationSession(
        {"board": board, "bar": bar},
        tuple(SensorFormat(s.name, s.columns, s.rows) for s in rig.sensors),
        volume,
        facing_rig(board),
    )
    specimen = Specimen("calibration artefacts", description="board of dots with three rings; ball bar")
    return Campaign(name, specimen, rig.name, timed, rig.views(), FringeSequence(), scene, session=session)
