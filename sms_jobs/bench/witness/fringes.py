"""Fringes that Mitsuba renders, as a camera of the virtual rig would record them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import cos, pi, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.peers import run_script
from sms_jobs.bench.witness.scenes import MeshTruth, Motions, Sheet, mesh_truth, sheets_of, told_sensor
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.phase.patterns import fringe_harmonics, span_px
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.scene import CameraResponse, Scene
from sms_jobs.records.views import Role, view_of
from sms_jobs.virtual_rig.campaigns import START
from sms_jobs.virtual_rig.noise import Noise
from sms_jobs.virtual_rig.rendering import Image

_SPACING_MM = 2.0
"""Of the nodes: a sheet that bends by 10 mm over 500 mm is 0.5 um off between them at most."""
_TEXELS = 4
"""Of paint along a pixel."""


@dataclass(frozen=True)
class Effects:
    """What light does besides going from paint to a pin-hole, and how many rays follow it.

    Attributes
    ----------
    lens_mm
        Diameter of the camera's lens and the distance at which it is in focus; None for a pin-hole.
    rays
        Along a side of half a pixel.
    """

    lens_mm: tuple[float, float] | None = None
    rays: int = 3


DIRECT = Effects()
"""Paint alone before a pin-hole, with 6 x 6 rays a pixel."""


@dataclass(frozen=True)
class Witnessed:
    """What another program shows of two states, recorded by state and view, and what is true of them."""

    recorded: dict[tuple[str, str], Measurement]
    truth: MeshTruth


def fringes_of_mitsuba(
    peers: Path, folder: Path, campaign: Campaign, state: str, effects: Effects = DIRECT
) -> Witnessed:
    """Let Mitsuba render a campaign's first view at rest and at a state; return what its camera records.

    Parameters
    ----------
    peers
        Environment of the other programs.
    folder
        An empty folder.
    campaign
        On the virtual rig.
    state
        Label of the state.
    effects
        Besides direct light.

    Raises
    ------
    SmsError
        When Mitsuba cannot render it.
    """
    scene = campaign.scene
    assert scene is not None
    view = view_of(campaign.views[0])
    assert view.projector is not None
    camera, projector = scene.rig.sensor(view.camera), scene.rig.sensor(view.projector)
    labels = (campaign.reference.label, state)
    motions = {label: campaign.state(label).deformation for label in labels}
    away = float(np.linalg.norm(camera.pose.centre() - np.array(scene.placement.translation)))
    sheets = sheets_of(scene, _SPACING_MM, away / camera.intrinsics.fx / _TEXELS)
    _write(folder, scene, sheets, motions)
    case = {
        "camera": told_sensor(camera),
        "projector": told_sensor(projector),
        "distance_mm": float(np.linalg.norm(projector.pose.centre() - np.array(scene.placement.translation))),
        "densities": campaign.sequence.densities,
        "orientations_rad": campaign.sequence.orientations_rad,
        "states": labels,
        "sheets": len(sheets),
        "rays": effects.rays,
        "blur_px": scene.camera.blur_px,
        "lens": None
        if effects.lens_mm is None
        else dict(zip(("aperture_mm", "focus_mm"), effects.lens_mm, strict=True)),
    }
    (folder / "case.json").write_text(json.dumps(case), encoding="utf-8")
    run_script(peers, "render_fringes.py", folder)
    hits = np.load(folder / "hits.npz")
    truth = mesh_truth(scene, sheets, (motions[labels[0]], motions[state]), hits["number"], hits["place"])
    recorded = {}
    for seed, label in enumerate(labels):
        light = np.load(folder / f"{label}.npz")
        recorded[label, campaign.views[0]] = record(
            light, campaign.sequence, scene, np.random.default_rng((scene.seed, seed))
        )
    return Witnessed(recorded, truth)


def _write(folder: Path, scene: Scene, sheets: tuple[Sheet, ...], motions: dict[str, Motions]) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    for k, sheet in enumerate(sheets):
        arrays[f"kept_{k}"], arrays[f"paint_{k}"] = sheet.kept, sheet.paint
        for label, done in motions.items():
            arrays[f"{label}_{k}"] = sheet.placed(scene, done)
    np.savez(folder / "sheets.npz", **arrays)  # type: ignore[arg-type]


def record(light: Any, sequence: FringeSequence, scene: Scene, rng: np.random.Generator) -> Measurement:
    """Return what a camera records of light, with its noise.

    Parameters
    ----------
    light
        `white` and `even` (rows, columns), `cosine` and `sine` (orientations * densities, rows, columns): the
        light of each pixel in units of a facing white surface's, of a white projector, under even light, and
        under the cosine and the sine of each pattern's phase.
    sequence
        The patterns; light adds, so that each frame is a sum of these.
    scene
        How camera and projector respond.
    rng
        Of the noise.
    """
    ambient = scene.camera.ambient * light["even"].astype(np.float64)
    white = light["white"].astype(np.float64)
    shown = [
        (orientation, density) for orientation in sequence.orientations_rad for density in sequence.densities
    ]
    texture = exposed(white + ambient, scene.camera, rng)
    frames = np.empty((sequence.frames, *texture.shape), np.uint16)
    for number, (orientation, density, step) in enumerate(sequence.patterns()):
        mean, swing = _brightness(scene, orientation, density)
        turn, index = 2.0 * pi * step / sequence.steps, shown.index((orientation, density))
        fringes = cos(turn) * light["cosine"][index] - sin(turn) * light["sine"][index]
        frames[number] = exposed(ambient + mean * white + swing * fringes, scene.camera, rng)
    return measurement_of(scene.camera, sequence, texture, frames)


def measurement_of(
    camera: CameraResponse, sequence: FringeSequence, texture: Image, frames: Image
) -> Measurement:
    """Return frames of a camera with what is known of its noise, rounding included."""
    noise = Noise.of(camera)
    read_noise = sqrt(noise.read_noise**2 + 1.0 / 12.0)
    return Measurement(START, sequence, noise.full_scale, noise.gain, read_noise, texture, ArrayStack(frames))


def exposed(light: Floats, camera: CameraResponse, rng: np.random.Generator) -> Image:
    """Return light as grey levels with shot and read noise."""
    noise = Noise.of(camera)
    level = np.maximum(camera.exposure * noise.full_scale * light, 0.0)
    level += rng.standard_normal(level.shape) * np.sqrt(noise.read_noise**2 + noise.gain * level)
    return np.clip(np.rint(level), 0.0, noise.full_scale).astype(np.uint16)


def _brightness(scene: Scene, orientation: float, density: float) -> tuple[float, float]:
    """Return mean and amplitude of a pattern as the projector throws it, which is linear and out of focus."""
    projector = next(sensor for sensor in scene.rig.sensors if sensor.role is Role.PROJECTOR)
    mean, swing = fringe_harmonics(
        density,
        span_px(projector.columns, projector.rows, orientation),
        visibility=scene.projector.visibility,
        defocus_px=scene.projector.defocus_px,
    )
    return float(mean), float(swing)
