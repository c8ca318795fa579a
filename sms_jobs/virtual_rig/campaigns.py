"""Campaigns on the virtual rig: the thesis's top hat under mid-point bending, and a small plate."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.geometry.camera import Intrinsics, Pose
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import (
    CameraResponse,
    MidPointBending,
    Plane,
    ProjectorResponse,
    Rigid,
    Scene,
    Speckle,
    TopHat,
    UniaxialStrain,
    Vector,
)
from sms_jobs.records.sensors import Box, Calibration, Role, Sensor

START = datetime(2026, 1, 5, 9, 0, tzinfo=UTC)
HOLD = timedelta(minutes=10)
ORIGIN = "exact parameters of the virtual rig"


@dataclass(frozen=True)
class Lens:
    """A lens, its focal length in units of the sensor's width, and its distortion."""

    focal: float
    k1: float
    k2: float
    p1: float
    p2: float


CAMERA_LENS = Lens(3.85, -0.08, 0.12, 2e-4, -3e-4)
PROJECTOR_LENS = Lens(3.15, -0.05, 0.08, -4e-4, 2e-4)


def aimed(name: str, columns: int, rows: int, lens: Lens, centre: Vector, roll_rad: float = 0.0) -> Sensor:
    """Return a sensor at `centre` (mm) that looks at the world's origin, Y up but for a roll.

    The principal point lies a little off the middle, as it does in life.
    """
    role = Role.CAMERA if name.startswith("C") else Role.PROJECTOR
    focal = lens.focal * columns
    cx, cy = (columns - 1) / 2.0 + 0.006 * columns, (rows - 1) / 2.0 - 0.004 * columns
    intrinsics = Intrinsics(focal, 1.001 * focal, cx, cy, lens.k1, lens.k2, lens.p1, lens.p2)
    up = np.array([np.sin(roll_rad), np.cos(roll_rad), 0.0])
    return Sensor(name, role, columns, rows, intrinsics, Pose.looking_at(np.array(centre), np.zeros(3), up))


def top_hat_bending(name: str, size: Literal["small", "full"]) -> tuple[Calibration, Campaign]:
    """Return the rig and the campaign of thesis section 5.3: a top hat, pushed out at its middle.

    Two scanners, each a camera and a projector 1.2 m apart, stand 2.5 m away on the left (C1, P1) and on
    the right (C2, P2), so far round that each sees one side of the hat and not the other. The clamping
    frame gives a little: every deformed state has a small rigid motion besides.

    Parameters
    ----------
    name
        Of the campaign.
    size
        Cameras of 512 x 512 px or of 1024 x 1024 px; the speckles have about 6 px in both.
    """
    pixels = {"small": 512, "full": 1024}[size]
    sensors = (
        aimed("C1", pixels, pixels, CAMERA_LENS, (-1500.0, 600.0, 1900.0), 0.02),
        aimed("C2", pixels, pixels, CAMERA_LENS, (1500.0, -600.0, 1900.0), -0.03),
        aimed("P1", 1024, 768, PROJECTOR_LENS, (-1500.0, -600.0, 1900.0), 0.01),
        aimed("P2", 1024, 768, PROJECTOR_LENS, (1500.0, 600.0, 1900.0), 0.02),
    )
    hat = TopHat()
    scene = Scene(
        sensors,
        hat,
        Speckle(diameter_mm=6.0 * 2500.0 / (CAMERA_LENS.focal * pixels)),
        _placed((0.02, -0.015, 0.01), (3.0, -2.0, 5.0)),
        CameraResponse(exposure=1.0),
        ProjectorResponse(defocus_px=0.8, visibility=0.95),
    )
    states = [LoadState("S00", 0.0, 0.0, START)]
    for number, deflection in enumerate((2.0, 5.0, 10.0), start=1):
        give = deflection / 10.0
        deformation = (
            MidPointBending(deflection, hat.width_mm, hat.height_mm),
            Rigid((1e-4 * give, -2e-4 * give, 1e-4 * give), (0.1 * give, -0.2 * give, 0.3 * give)),
        )
        load_n, time = 38.0 * deflection, START + number * HOLD
        states.append(LoadState(f"S{number:02d}", load_n, deflection, time, deformation=deformation))
    specimen = Specimen("top hat", "aluminium", "1 mm sheet bent along four lines, two holes in the top")
    calibration = Calibration(
        "virtual-rig", sensors, Box((-270.0, -270.0, -250.0), (270.0, 270.0, 250.0)), START, ORIGIN
    )
    campaign = Campaign(
        name, specimen, calibration.rig, tuple(states), calibration.pairs(), FringeSequence(), scene
    )
    return calibration, campaign


def small_plate(name: str) -> tuple[Calibration, Campaign]:
    """Return a rig and a campaign that go through every job kind in seconds.

    A flat plate of 150 mm, stretched by 0.5 % and moved by about a millimetre, seen by one camera of
    128 x 128 px with two projectors.
    """
    lens = Lens(7.0, -0.08, 0.1, 2e-4, -3e-4)
    sensors = (
        aimed("C1", 128, 128, lens, (-150.0, 50.0, 1250.0), 0.02),
        aimed("P1", 256, 192, Lens(5.0, -0.05, 0.1, 1e-4, 2e-4), (450.0, -100.0, 1150.0)),
        aimed("P2", 256, 192, Lens(5.0, -0.04, 0.1, -1e-4, 1e-4), (-700.0, 150.0, 1050.0)),
    )
    scene = Scene(
        sensors,
        Plane(150.0, 150.0),
        Speckle(diameter_mm=7.0),
        _placed((0.05, -0.03, 0.04), (1.0, -2.0, 3.0)),
        CameraResponse(exposure=0.9),
    )
    stretched = (UniaxialStrain(0.005, 0.3), Rigid((0.001, -0.002, 0.003), (0.8, -0.5, 0.6)))
    states = (
        LoadState("S00", 0.0, 0.0, START),
        LoadState("S01", 1200.0, 0.75, START + HOLD, deformation=stretched),
    )
    specimen = Specimen("small plate", "polymer", "flat plate of 150 mm in tension")
    calibration = Calibration(
        "small-virtual-rig", sensors, Box((-100.0, -100.0, -50.0), (100.0, 100.0, 50.0)), START, ORIGIN
    )
    sequence = FringeSequence((16, 15, 14, 12, 8))
    campaign = Campaign(name, specimen, calibration.rig, states, calibration.pairs(), sequence, scene)
    return calibration, campaign


def _placed(rotation_rad: Vector, translation_mm: Vector) -> Pose:
    return Pose.from_arrays(Rotation.from_rotvec(rotation_rad).as_matrix(), np.array(translation_mm))
