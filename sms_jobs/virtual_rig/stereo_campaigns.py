"""Campaigns of two cameras that look at one specimen together, lit by a lamp or by a projector's fringes."""

from __future__ import annotations

from dataclasses import replace
from math import cos, radians, sin
from typing import TypeAlias

from sms_jobs.records.campaign import LoadState, Specimen
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import (
    CameraResponse,
    Cylinder,
    Deformation,
    Gloss,
    MidPointBending,
    PlateWithHoleAndStep,
    ProjectorResponse,
    Rigid,
    Scene,
    Speckle,
    Surface,
    UniaxialStrain,
    Vector,
)
from sms_jobs.records.sensors import Box, Rig, Sensor
from sms_jobs.virtual_rig.campaigns import HOLD, START, Lens, Made, aimed, made, placed

TELEPHOTO = Lens(2.8, -0.02, 0.0, 1e-4, -1e-4)
"""Sees 180 mm at half a metre, hardly distorted."""
WIDE_ANGLE = Lens(1.0, -0.2, 0.03, 2e-4, -3e-4)
"""Sees half a metre at half a metre; the corners lie 10 % nearer to the middle than a pin-hole's."""

Motions: TypeAlias = tuple[Deformation, ...]


def stereo_rig(
    columns: int = 640,
    rows: int = 512,
    lens: Lens = TELEPHOTO,
    stand_off_mm: float = 500.0,
    angle_rad: float = radians(20.0),
) -> Rig:
    """Return a rig of two cameras, C1 on the left and C2 on the right, that look at the world's origin.

    Parameters
    ----------
    columns, rows
        Size of the images, px.
    lens
        Of both; the focal length is in units of the sensor's width.
    stand_off_mm
        Distance of each pin-hole from the origin, mm.
    angle_rad
        Between the cameras' axes.
    """

    def camera(name: str, side: float, roll_rad: float) -> Sensor:
        turn = side * angle_rad / 2.0
        centre = (stand_off_mm * sin(turn), 0.02 * side * stand_off_mm, stand_off_mm * cos(turn))
        return aimed(name, columns, rows, lens, centre, roll_rad)

    return Rig("virtual-stereo-rig", (camera("C1", -1.0, 0.01), camera("C2", 1.0, -0.015)))


def curved(field_mm: float) -> Surface:
    """Return a part of a cylinder that fills most of a field of view that is `field_mm` wide."""
    return Cylinder(0.6 * field_mm, 0.75 * field_mm, 0.58 * field_mm)


def stepped(field_mm: float) -> Surface:
    """Return a plate with a hole and a step that fills most of a field of view that is `field_mm` wide."""
    return PlateWithHoleAndStep(
        0.78 * field_mm, 0.6 * field_mm, (-0.18 * field_mm, 0.06 * field_mm), 0.07 * field_mm,
        (0.18 * field_mm, -0.06 * field_mm), (0.2 * field_mm, 0.25 * field_mm), 0.05 * field_mm,
    )  # fmt: skip


def usual_deformations(field_mm: float) -> tuple[Motions, ...]:
    """Return a rigid shift, a bending and a tension, in a field of view that is `field_mm` wide."""
    bent = MidPointBending(0.01 * field_mm, field_mm, field_mm)
    give = Rigid((2e-4, -4e-4, 2e-4), (0.0, -2e-4 * field_mm, 3e-4 * field_mm))
    shift: Vector = (4e-3 * field_mm, -3e-3 * field_mm, 5e-3 * field_mm)
    return (Rigid((0.002, -0.003, 0.004), shift),), (bent, give), (UniaxialStrain(0.005, 0.33), give)


def stereo_campaign(
    name: str,
    *,
    rig: Rig | None = None,
    surface: Surface | None = None,
    deformations: tuple[Motions, ...] | None = None,
    camera: CameraResponse | None = None,
    speckle_px: float = 4.0,
    lamp_mm: Vector | None = None,
    gloss: Gloss | None = None,
    seed: int = 0,
) -> Made:
    """Return a rig of two cameras with its exact calibration, and a campaign of its view C1C2.

    Parameters
    ----------
    name
        Of the campaign.
    rig
        Cameras; that of `stereo_rig` if none is given.
    surface
        The specimen, its origin near the world's; `curved` of the field of view if none is given.
    deformations
        What is done to it in S01, S02, ...; S00 is the reference at rest. `usual_deformations` if none are
        given.
    camera
        Noise, exposure and blur of the cameras; a 12 bit camera's if none are given.
    speckle_px
        Mean diameter of a speckle in px of C1 at the origin.
    lamp_mm, gloss, seed
        See `Scene`.
    """
    rig = stereo_rig() if rig is None else rig
    first = rig.sensor("C1")
    px_mm = sum(x * x for x in first.pose.centre()) ** 0.5 / first.intrinsics.fx
    field_mm = px_mm * first.columns
    scene = Scene(
        rig,
        curved(field_mm) if surface is None else surface,
        Speckle(diameter_mm=speckle_px * px_mm),
        placed((0.03, -0.02, 0.01), (0.004 * field_mm, -0.006 * field_mm, 0.02 * field_mm)),
        CameraResponse() if camera is None else camera,
        seed=seed,
        gloss=gloss,
        lamp_mm=lamp_mm,
    )
    done = usual_deformations(field_mm) if deformations is None else deformations
    states = tuple(
        LoadState(f"S{number:02d}", 500.0 * number, time=START + number * HOLD, deformation=deformation)
        for number, deformation in enumerate(((), *done))
    )
    half = 0.55 * field_mm
    specimen = Specimen("stereo specimen", "polymer", "speckled, lit by a lamp between the cameras")
    volume = Box((-half, -half, -half / 2.0), (half, half, half / 2.0))
    return made(name, volume, specimen, states, FringeSequence(), scene)


def shared_fringes_rig(columns: int = 640, rows: int = 512) -> Rig:
    """Return the cameras of `stereo_rig` with a projector P1 above them, 20 degrees from both."""
    projector = aimed("P1", 640, 480, Lens(2.2, -0.03, 0.05, -2e-4, 3e-4), (30.0, 180.0, 460.0), -0.02)
    return Rig("virtual-shared-fringes", (*stereo_rig(columns, rows).sensors, projector))


def shared_fringes_campaign(
    name: str,
    *,
    rig: Rig | None = None,
    surface: Surface | None = None,
    speckle_px: float = 0.0,
    sequence: FringeSequence | None = None,
) -> Made:
    """Return two cameras and a projector with their exact calibration, and a campaign of C1C2P1 and C1P1.

    Parameters
    ----------
    name
        Of the campaign; S01 is its specimen at rest, S00, moved.
    rig
        That of `shared_fringes_rig` if none is given.
    surface
        The specimen; `curved` of the field of view if none is given.
    speckle_px
        Mean diameter of a speckle in px of C1 at the origin; 0 for a plain surface.
    sequence
        What is projected; the default one if none is given.
    """
    rig = shared_fringes_rig() if rig is None else rig
    first = rig.sensor("C1")
    px_mm = sum(x * x for x in first.pose.centre()) ** 0.5 / first.intrinsics.fx
    field_mm = px_mm * first.columns
    scene = Scene(
        rig,
        curved(field_mm) if surface is None else surface,
        Speckle(diameter_mm=speckle_px * px_mm) if speckle_px else None,
        placed((0.03, -0.02, 0.01), (0.004 * field_mm, -0.006 * field_mm, 0.02 * field_mm)),
        CameraResponse(),
        ProjectorResponse(defocus_px=0.7, visibility=0.9),
    )
    motion = usual_deformations(field_mm)[0]
    states = (
        LoadState("S00", time=START),
        LoadState("S01", time=START + HOLD, deformation=motion),
    )
    half = 0.55 * field_mm
    volume = Box((-half, -half, -half / 2.0), (half, half, half / 2.0))
    specimen = Specimen("specimen", "polymer", "lit by a projector that nobody needs to calibrate")
    shown = FringeSequence() if sequence is None else sequence
    calibration, campaign = made(name, volume, specimen, states, shown, scene)
    return calibration, replace(campaign, views=("C1C2P1", "C1P1"))
