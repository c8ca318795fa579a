"""Speckles before two cameras that riley renders, as the cameras of the virtual rig would record them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from sms_jobs.bench.peers import run_script
from sms_jobs.bench.witness.fringes import Witnessed, exposed, measurement_of
from sms_jobs.bench.witness.scenes import mesh_truth, sheets_of, told_sensor
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.sensors import Rig, Sensor
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.campaigns import Made
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

_COLUMNS, _ROWS = 640, 512
_SPACING_MM = 1.0
_TEXELS = 4
"""Of paint along a pixel."""
_RAYS = 4
"""Along a side of half a pixel."""


def cylinder_in_tension() -> Made:
    """Return the stereo rig and its cylinder, the principal points whole halves of a pixel off the middle.

    Riley's cameras look at the middle of their image: a larger one is rendered and cut.
    """

    def halves(sensor: Sensor) -> Sensor:
        lens = sensor.intrinsics
        middle = (sensor.columns - 1) / 2.0, (sensor.rows - 1) / 2.0
        cx, cy = (m + round(2.0 * (c - m)) / 2.0 for m, c in zip(middle, (lens.cx, lens.cy), strict=True))
        return replace(sensor, intrinsics=replace(lens, cx=cx, cy=cy))

    rig = stereo_rig(_COLUMNS, _ROWS)
    return stereo_campaign("cylinder", rig=Rig(rig.name, tuple(map(halves, rig.sensors))))


def speckles_of_riley(peers: Path, folder: Path, campaign: Campaign, state: str) -> Witnessed:
    """Let riley render a campaign's first view at rest and at a state; return what its cameras record.

    `peers` is the environment of the other programs, `folder` an empty folder.

    Raises
    ------
    SmsError
        When riley cannot render it.
    """
    scene = campaign.scene
    assert scene is not None
    view = view_of(campaign.views[0])
    cameras = {name: scene.rig.sensor(name) for name in (view.camera, *view.partners)}
    labels = (campaign.reference.label, state)
    motions = [campaign.state(label).deformation for label in labels]
    first = cameras[view.camera]
    away = float(np.linalg.norm(first.pose.centre() - np.array(scene.placement.translation)))
    sheets = sheets_of(scene, _SPACING_MM, away / first.intrinsics.fx / _TEXELS)
    lamp = np.mean([sensor.pose.centre() for sensor in cameras.values()], axis=0)
    distance = float(np.linalg.norm(lamp - np.array(scene.placement.translation)))
    arrays: dict[str, Floats] = {}
    for k, sheet in enumerate(sheets):
        arrays[f"paint_{k}"] = sheet.paint
        for label, done in zip(labels, motions, strict=True):
            place = sheet.placed(scene, done)
            arrays[f"{label}_{k}"], arrays[f"{label}_light_{k}"] = place, _lit(place, lamp, distance)
    np.savez(folder / "sheets.npz", **arrays)  # type: ignore[arg-type]
    case = {
        "cameras": {name: told_sensor(sensor) for name, sensor in cameras.items()},
        "states": labels,
        "sheets": len(sheets),
        "rays": _RAYS,
        "blur_px": scene.camera.blur_px,
    }
    (folder / "case.json").write_text(json.dumps(case), encoding="utf-8")
    run_script(peers, "render_speckles.py", folder)
    hits = np.load(folder / "hits.npz")
    truth = mesh_truth(scene, sheets, (motions[0], motions[1]), hits["number"], hits["place"])
    rng = np.random.default_rng(scene.seed)
    recorded = {}
    for label in labels:
        light = np.load(folder / f"{label}.npz")
        for name in cameras:
            texture = exposed(
                (1.0 + scene.camera.ambient) * light[name].astype(np.float64), scene.camera, rng
            )
            recorded[label, name] = measurement_of(scene.camera, FringeSequence(), texture, texture[None])
    return Witnessed(recorded, truth)


def _lit(place: Floats, lamp: Floats, distance: float) -> Floats:
    """Return how strongly a lamp lights nodes (m, n, 3): a facing white surface at a distance with 1."""
    along_a, along_b = np.gradient(place, axis=(0, 1), edge_order=2)
    normal = np.cross(along_a, along_b)
    towards = lamp - place
    away = np.linalg.norm(towards, axis=-1)
    cosine = np.sum(normal * towards, axis=-1) / (np.linalg.norm(normal, axis=-1) * away)
    return np.asarray(np.maximum(cosine, 0.0) * np.square(distance / away))
