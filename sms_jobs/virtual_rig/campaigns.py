"""Campaigns on the virtual rig: the thesis's experiments, a tension panel, and a small plate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import (
    CameraResponse,
    MidPointBending,
    Plane,
    PlateAndMirror,
    PlateWithHoleAndStep,
    ProjectorResponse,
    Rigid,
    Scene,
    Speckle,
    TopHat,
    UniaxialStrain,
    Vector,
)
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.views import role_of

START = datetime(2026, 1, 5, 9, 0, tzinfo=UTC)
HOLD = timedelta(minutes=10)
ORIGIN = "exact parameters of the virtual rig"


Made: TypeAlias = tuple[Calibration, Campaign]
Size: TypeAlias = Literal["small", "full"]
PIXELS: dict[Size, int] = {"small": 512, "full": 1024}


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

BENDING_VOLUME = Box((-270.0, -270.0, -250.0), (270.0, 270.0, 250.0))
BENDING_PROJECTOR = ProjectorResponse(defocus_px=0.8, visibility=0.95)


def aimed(name: str, columns: int, rows: int, lens: Lens, centre: Vector, roll_rad: float = 0.0) -> Sensor:
    """Return a sensor at `centre` (mm) that looks at the world's origin, Y up but for a roll.

    The principal point lies a little off the middle, as it does in life.
    """
    role = role_of(name)
    focal = lens.focal * columns
    cx, cy = (columns - 1) / 2.0 + 0.006 * columns, (rows - 1) / 2.0 - 0.004 * columns
    intrinsics = Intrinsics(focal, 1.001 * focal, cx, cy, lens.k1, lens.k2, lens.p1, lens.p2)
    up = np.array([np.sin(roll_rad), np.cos(roll_rad), 0.0])
    return Sensor(name, role, columns, rows, intrinsics, Pose.looking_at(np.array(centre), np.zeros(3), up))


def bending_rig(size: Size) -> Rig:
    """Return the rig of thesis section 5.3.

    Two scanners, each a camera and a projector 1.2 m apart, stand 2.5 m away on the left (C1, P1) and on
    the right (C2, P2). Cameras have 512 x 512 px or 1024 x 1024 px.
    """
    pixels = PIXELS[size]
    sensors = (
        aimed("C1", pixels, pixels, CAMERA_LENS, (-1500.0, 600.0, 1900.0), 0.02),
        aimed("C2", pixels, pixels, CAMERA_LENS, (1500.0, -600.0, 1900.0), -0.03),
        aimed("P1", 1024, 768, PROJECTOR_LENS, (-1500.0, -600.0, 1900.0), 0.01),
        aimed("P2", 1024, 768, PROJECTOR_LENS, (1500.0, 600.0, 1900.0), 0.02),
    )
    return Rig(f"virtual-rig-{pixels}", sensors)


def top_hat_bending(name: str, size: Size, deflections_mm: Sequence[float] = (2.0, 5.0, 10.0)) -> Made:
    """Return the rig and the campaign of thesis section 5.3: a top hat, pushed out at its middle.

    The scanners of `bending_rig` stand so far round that each sees one side of the hat and not the other.
    The clamping frame gives a little: every deformed state has a small rigid motion besides.

    Parameters
    ----------
    name
        Of the campaign.
    size
        Cameras of 512 x 512 px or of 1024 x 1024 px; the speckles have about 6 px in both.
    deflections_mm
        Of the middle, a state each; the thesis has 1 to 10 mm in steps of 1 mm.
    """
    hat = TopHat()
    scene = Scene(
        bending_rig(size),
        hat,
        Speckle(diameter_mm=6.0 * 2500.0 / (CAMERA_LENS.focal * PIXELS[size])),
        placed((0.02, -0.015, 0.01), (3.0, -2.0, 5.0)),
        CameraResponse(exposure=1.0),
        BENDING_PROJECTOR,
    )
    states = bent_states(hat, deflections_mm)
    specimen = Specimen("top hat", "aluminium", "1 mm sheet bent along four lines, two holes in the top")
    return made(name, BENDING_VOLUME, specimen, states, FringeSequence(), scene)


def bent_states(hat: TopHat, deflections_mm: Sequence[float]) -> tuple[LoadState, ...]:
    """Return a top hat at rest, and pushed out at its middle; its frame gives a hundredth of that."""
    states = [LoadState("S00", 0.0, 0.0, START)]
    for number, deflection in enumerate(deflections_mm, start=1):
        give = deflection / 10.0
        deformation = (
            MidPointBending(deflection, hat.width_mm, hat.height_mm),
            Rigid((1e-4 * give, -2e-4 * give, 1e-4 * give), (0.1 * give, -0.2 * give, 0.3 * give)),
        )
        load_n, time = 38.0 * deflection, START + number * HOLD
        states.append(LoadState(f"S{number:02d}", load_n, deflection, time, deformation=deformation))
    return tuple(states)


def top_hat_before_two_cameras(name: str, size: Size, deflections_mm: Sequence[float]) -> Made:
    """Return the rig and the campaign with which thesis section 5.3 compares: a top hat, two ways at once.

    Cameras C1 and C2 stand 34 degrees apart, as in the thesis's Table 4, and measure as the view C1C2, lit by
    a lamp; C1 measures with the projector P1 beside it as well, as the view C1P1.
    """
    pixels, hat, half = PIXELS[size], TopHat(), np.radians(17.0)
    x, z = 2500.0 * float(np.sin(half)), 2500.0 * float(np.cos(half))
    sensors = (
        aimed("C1", pixels, pixels, CAMERA_LENS, (-x, -50.0, z), 0.01),
        aimed("C2", pixels, pixels, CAMERA_LENS, (x, 50.0, z), -0.015),
        aimed("P1", 1024, 768, PROJECTOR_LENS, (450.0, -100.0, 2460.0), -0.02),
    )
    scene = Scene(
        Rig("virtual-stereo-scanner", sensors),
        hat,
        Speckle(diameter_mm=6.0 * 2500.0 / (CAMERA_LENS.focal * pixels)),
        placed((0.02, -0.015, 0.01), (3.0, -2.0, 5.0)),
        CameraResponse(exposure=0.9),
        BENDING_PROJECTOR,
    )
    specimen = Specimen("top hat", "aluminium", "1 mm sheet bent along four lines, two holes in the top")
    states = bent_states(hat, deflections_mm)
    calibration, campaign = made(name, BENDING_VOLUME, specimen, states, FringeSequence(), scene)
    return calibration, replace(campaign, views=("C1P1", "C1C2"))


def small_plate(name: str) -> Made:
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
        Rig("small-virtual-rig", sensors),
        Plane(150.0, 150.0),
        Speckle(diameter_mm=7.0),
        placed((0.05, -0.03, 0.04), (1.0, -2.0, 3.0)),
        CameraResponse(exposure=0.9),
    )
    stretched = (UniaxialStrain(0.005, 0.3), Rigid((0.001, -0.002, 0.003), (0.8, -0.5, 0.6)))
    states = (
        LoadState("S00", 0.0, 0.0, START),
        LoadState("S01", 1200.0, 0.75, START + HOLD, deformation=stretched),
    )
    specimen = Specimen("small plate", "polymer", "flat plate of 150 mm in tension")
    volume = Box((-100.0, -100.0, -50.0), (100.0, 100.0, 50.0))
    return made(name, volume, specimen, states, FringeSequence((16, 15, 14, 12, 8)), scene)


def hole_and_step_translation(name: str, size: Size) -> Made:
    """Return the rig and the campaign of thesis section 4.6: a plate with a hole and a step, translated.

    One scanner, 2.7 m away, sees a plate of 640 mm that is tilted by 10 degrees and moved along X: by
    0.127 mm a state as far as 1.016 mm, then by 1.016 mm as far as 10.16 mm.
    """
    pixels = PIXELS[size]
    lens = Lens(3.3, -0.08, 0.12, 2e-4, -3e-4)
    sensors = scanner(pixels, lens, Lens(2.4, -0.05, 0.08, -4e-4, 2e-4), 2700.0)
    surface = PlateWithHoleAndStep(
        640.0, 640.0, (-140.0, 60.0), 70.0, step_centre_mm=(150.0, -80.0), step_size_mm=(180.0, 220.0),
        step_height_mm=40.0,
    )  # fmt: skip
    scene = Scene(
        Rig("virtual-scanner", sensors),
        surface,
        Speckle(diameter_mm=7.0 * 2700.0 / (lens.focal * pixels)),
        placed((0.0, 0.1745, 0.0), (0.0, 0.0, 0.0)),
        CameraResponse(exposure=0.9),
        ProjectorResponse(defocus_px=0.8, visibility=0.95),
    )
    shifts = (*(0.127 * n for n in range(8)), *(1.016 * n for n in range(1, 11)))
    states = tuple(
        LoadState(
            f"S{number:02d}",
            displacement_mm=shift,
            time=START + number * HOLD,
            deformation=(Rigid(translation_mm=(shift, 0.0, 0.0)),) if number else (),
        )
        for number, shift in enumerate(shifts)
    )
    specimen = Specimen("plate with hole and step", "plastic", "discontinuous plate on a translation stage")
    return made(name, cube(360.0), specimen, states, FringeSequence(), scene)


def tension_panel(name: str, size: Size) -> Made:
    """Return the rig and the campaign of a flat panel in tension, 300 mm in the image.

    Strains of 0, 500, 1000 and 2000 microstrain, each with a small rigid motion of the grips.
    """
    pixels = PIXELS[size]
    lens = Lens(6.6, -0.08, 0.12, 2e-4, -3e-4)
    sensors = scanner(pixels, lens, Lens(5.0, -0.05, 0.08, -4e-4, 2e-4), 2200.0)
    scene = Scene(
        Rig("virtual-scanner", sensors),
        Plane(290.0, 290.0),
        Speckle(diameter_mm=6.0 * 2200.0 / (lens.focal * pixels)),
        placed((0.03, -0.02, 0.01), (2.0, -1.0, 4.0)),
        CameraResponse(exposure=0.9),
        ProjectorResponse(defocus_px=0.8, visibility=0.95),
    )
    states = [LoadState("S00", 0.0, 0.0, START)]
    for number, strain in enumerate((5e-4, 1e-3, 2e-3), start=1):
        motion = Rigid((1e-4, -2e-4, 1e-4), (100.0 * strain, -50.0 * strain, 80.0 * strain))
        deformation = (UniaxialStrain(strain, 0.33), motion)
        load_n, time = 7.0e7 * strain, START + number * HOLD
        states.append(LoadState(f"S{number:02d}", load_n, 290.0 * strain, time, deformation=deformation))
    specimen = Specimen("tension panel", "aluminium", "flat panel, 2 mm thick, stretched along x")
    return made(name, cube(160.0), specimen, tuple(states), FringeSequence(), scene)


def plate_and_mirror(name: str, size: Size, fringes: int = 64) -> Made:
    """Return the rig and the campaign of thesis section 7.3.1: a white plate beside a mirror.

    The plate stands upright and faces the scanner, the mirror lies below it and lights its lower half a
    second time. The sequence is that of Fourier domain ranging, 0 .. `fringes` - 1.
    """
    pixels = PIXELS[size]
    lens = Lens(3.6, -0.08, 0.12, 2e-4, -3e-4)
    sensors = scanner(pixels, lens, Lens(2.8, -0.05, 0.08, -4e-4, 2e-4), 2500.0)
    opening = 2.0 * np.pi / 3.0
    lean = (np.pi - opening) / 2.0
    # The hinge is brought along X, the plate along Y, and the plate's normal along Z.
    upright = np.array(
        [[0.0, 1.0, 0.0], [-np.cos(lean), 0.0, np.sin(lean)], [np.sin(lean), 0.0, np.cos(lean)]]
    )
    scene = Scene(
        Rig("virtual-scanner", sensors),
        PlateAndMirror(400.0, 300.0, opening, 0.5, 200.0),
        placement=Pose.from_arrays(upright, np.array([0.0, -110.0, -50.0])),
        camera=CameraResponse(exposure=0.6),
    )
    states = (LoadState("S00", time=START),)
    specimen = Specimen("plate and mirror", "plastic", "diffuse white plate and a mirror in a V")
    sequence = FringeSequence(tuple(range(fringes)))
    return made(name, cube(330.0), specimen, states, sequence, scene)


def scanner(pixels: int, camera: Lens, projector: Lens, distance: float) -> tuple[Sensor, ...]:
    """Return one camera and one projector, 1.2 m apart along x, at a distance from the world's origin."""
    z = float(np.sqrt(distance**2 - 600.0**2))
    return (
        aimed("C1", pixels, pixels, camera, (-600.0, 40.0, z), 0.01),
        aimed("P1", 1024, 768, projector, (600.0, -30.0, z), -0.02),
    )


def cube(half_mm: float) -> Box:
    """Return a cube about the world's origin."""
    return Box((-half_mm, -half_mm, -half_mm), (half_mm, half_mm, half_mm))


def made(
    name: str,
    volume: Box,
    specimen: Specimen,
    states: tuple[LoadState, ...],
    sequence: FringeSequence,
    scene: Scene,
) -> Made:
    """Return a campaign on a scene, measured by all its views, with its exact calibration."""
    rig = scene.rig
    calibration = Calibration(rig, volume, START, ORIGIN)
    return calibration, Campaign(name, specimen, rig.name, states, rig.views(), sequence, scene)


def placed(rotation_rad: Vector, translation_mm: Vector) -> Pose:
    """Return the pose of a rotation vector in rad and a shift in mm."""
    return Pose.from_arrays(Rotation.from_rotvec(rotation_rad).as_matrix(), np.array(translation_mm))
