"""Scenes for other renderers are the virtual rig's, and what they show is recorded as a camera would."""

from __future__ import annotations

import sys
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest
from support.command import inside

from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.groups import witness
from sms_jobs.bench.peers import PEERS
from sms_jobs.bench.witness.effects import halved_hat
from sms_jobs.bench.witness.fringes import record
from sms_jobs.bench.witness.scenes import mesh_truth, sheets_of, told_sensor
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, Cylinder, Simulation
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.campaigns import Made, top_hat_bending
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig
from sms_jobs.virtual_rig.surfaces import patches_of
from sms_jobs.virtual_rig.truth import exact_truth

SPACING_MM = 2.0


def cylinder() -> Made:
    return stereo_campaign("cylinder", rig=stereo_rig(80, 64), surface=Cylinder(110.0, 130.0, 100.0))


@pytest.mark.parametrize("made", [top_hat_bending("hat", "small"), cylinder()], ids=["hat", "cylinder"])
def test_the_truth_of_a_mesh_is_that_of_the_surface(made: Made) -> None:
    _, campaign = made
    scene = campaign.scene
    assert scene is not None
    view, last = view_of(campaign.views[0]), campaign.states[-1]
    exact = exact_truth(
        *(Simulation.of(scene, view, s.deformation, s.label) for s in (campaign.reference, last)),
        view.partners,
    )
    sheets = sheets_of(scene, SPACING_MM, 1.0)
    number = np.where(exact.shape.seen, exact.shape.region - 1, -1)
    place = np.full((2, *number.shape), np.nan)
    for index, (sheet, patch) in enumerate(zip(sheets, patches_of(scene.surface), strict=True)):
        here = number == index
        own = exact.shape.material[:, here] - np.array(patch.origin)[:, None]
        a = np.array(patch.along_a) @ own
        if np.isfinite(patch.radius):
            a = patch.radius * np.arcsin(a / patch.radius)
        b = np.array(patch.along_b) @ own
        place[:, here] = [(a - sheet.a[0]) / np.ptp(sheet.a), (b - sheet.b[0]) / np.ptp(sheet.b)]

    found = mesh_truth(scene, sheets, ((), last.deformation), number, place)

    seen = exact.shape.seen
    assert np.array_equal(np.isfinite(found.position[0]), seen)
    # A chord is off its arc by spacing^2 / (8 R), R the cylinder's radius of 110 mm; the hat is flat.
    np.testing.assert_allclose(
        found.position[:, seen], exact.shape.xyz[:, seen], atol=SPACING_MM**2 / (8 * 110.0)
    )
    # A deflection of 10 mm over 500 mm has a second derivative of 24 * 10 / 500^2 per mm along both sides,
    # and between nodes is off by spacing^2 / 8 of each; the cylinder's 0.5 % by 0.5 % of its arc's.
    bend = 24.0 * 10.0 / 500.0**2
    np.testing.assert_allclose(
        found.displacement[:, seen], exact.displacement[:, seen], atol=2.0 * SPACING_MM**2 / 8.0 * bend
    )
    # Differences are good to spacing^2 / 3 (one-sided at edges) of the third derivative of the deflection,
    # 96 * 10 / 500^3 per mm^2, times its largest slope, 0.06; where it jumps, to spacing / 2 of that jump of
    # twice as much. Interpolation of products of slopes: spacing^2 / 8 of twice the squared bend. The arc of
    # the cylinder stretches as its chord does, to spacing^2 / (24 R^2) of its 0.5 %.
    jump = 0.06 * SPACING_MM**2 * 96.0 * 10.0 / 500.0**3
    within = jump + SPACING_MM**2 / 4 * bend**2 + 0.005 * SPACING_MM**2 / (8 * 110.0**2)
    # A mesh's z points outwards, the surface's to the camera: seen from the back xy is the other way round.
    outside = np.full(seen.shape, False)
    for index, patch in enumerate(patches_of(scene.surface)):
        middle = np.cross(patch.along_a, patch.along_b) @ scene.placement.matrix().T
        outside |= (number == index) & (np.tensordot(middle, exact.shape.normal, 1) > 0.0)
    assert np.count_nonzero(outside) > 0.99 * np.count_nonzero(seen)
    np.testing.assert_allclose(found.strain[:, outside], exact.green_lagrange[:, outside], atol=2.0 * within)


def test_a_sheet_has_holes_and_the_print_of_its_patch() -> None:
    scene = top_hat_bending("hat", "small")[1].scene
    assert scene is not None
    sheets = sheets_of(scene, SPACING_MM, 0.5)
    assert [s.kept.all() for s in sheets] == [True, True, False, True, True]
    top = sheets[2]
    missing = np.count_nonzero(~top.kept) * np.ptp(top.a) * np.ptp(top.b) / top.kept.size
    # Two discs of 25 mm. Cells count by their middles, off by 0.3 of a cell of 4 mm^2 each along the edge.
    # The discs and their eighths are alike: 16 times the sum over 10 cells, 60 mm^2 of 3927, thrice.
    assert missing == pytest.approx(2.0 * pi * 25.0**2, rel=0.05)
    assert scene.speckle is not None
    paint = np.concatenate([s.paint.ravel() for s in sheets])
    assert paint.min() >= scene.speckle.dark
    assert paint.max() <= scene.speckle.bright
    # Blobs cover about 45 % of the ground.
    assert np.mean(paint < 0.5 * (scene.speckle.dark + scene.speckle.bright)) == pytest.approx(0.45, abs=0.1)


def test_what_is_rendered_is_recorded_as_a_camera_would(rng: np.random.Generator) -> None:
    made = top_hat_bending("hat", "small")[1].scene
    assert made is not None
    quiet = CameraResponse(bits=16, exposure=0.8, full_well=1e12, read_noise=0.0, ambient=0.1)
    scene = replace(made, camera=quiet)
    sequence = FringeSequence((8, 5), 4, (0.0,))
    phase = np.array([[0.3, 1.2, -2.0]])
    shape = (1, 3)
    light = {
        "white": np.full(shape, 0.5),
        "even": np.full(shape, 0.25),
        "cosine": np.stack([0.5 * np.cos(t * phase) for t in (8, 5)]),
        "sine": np.stack([0.5 * np.sin(t * phase) for t in (8, 5)]),
    }

    found = record(light, sequence, scene, rng)

    full = 0.8 * 65535
    # Rounding to whole grey levels.
    assert np.abs(found.texture - full * (0.5 + 0.1 * 0.25)).max() <= 0.51
    frames = np.stack([found.frames.frame(i) for i in range(8)]).astype(np.float64).reshape(2, 4, 3)
    for t, steps in zip((8, 5), frames, strict=True):
        swing = (steps * np.exp(-2j * pi * np.arange(4) / 4)[:, None]).sum(axis=0) / 2.0
        # Two of four levels that are rounded by half a level, over the amplitude of 13,000.
        assert np.abs(np.angle(swing * np.exp(-1j * t * phase[0]))).max() < 2e-4
        # The projector's visibility, less what its defocus takes at 5 to 8 of 1024 / 2 fringes: below 0.1 %.
        assert np.abs(swing) == pytest.approx(full * 0.5 * 0.5 * 0.95, rel=1e-3)
    assert found.gain == pytest.approx(65535 / 1e12)


def test_noise_is_what_is_stated(rng: np.random.Generator) -> None:
    scene = top_hat_bending("hat", "small")[1].scene
    assert scene is not None
    shape = (200, 200)
    light = {"white": np.full(shape, 0.5), "even": np.zeros(shape)}
    light |= {"cosine": np.zeros((1, *shape)), "sine": np.zeros((1, *shape))}
    found = record(light, FringeSequence((1,), 4, (0.0,)), scene, rng)
    # 40,000 levels tell a deviation to 1 / sqrt(2 n) = 0.35 %.
    stated = float(found.noise(np.float32(0.5 * 4095 * scene.camera.exposure)))
    assert found.texture.std() == pytest.approx(stated, rel=0.015)


def test_a_sensor_is_told_as_opencv_has_it() -> None:
    camera = top_hat_bending("hat", "small")[0].rig.sensor("C1")
    told = told_sensor(camera)
    assert told["matrix"][0][2] == camera.intrinsics.cx
    assert told["distortion"][2] == camera.intrinsics.p1
    centre = -np.array(told["rotation"]).T @ np.array(told["translation"])
    np.testing.assert_allclose(centre, camera.pose.centre(), atol=1e-9)


def test_pixels_twice_as_large_see_the_same() -> None:
    whole, half = (made[0].rig.sensor("C1") for made in (top_hat_bending("hat", "small"), halved_hat()))
    point = np.array([[10.0, -20.0, 30.0]])
    seen, coarse = (project(one.intrinsics, one.pose, point)[0] for one in (whole, half))
    # The edge of the image lies half a pixel before the first one's centre, of either size.
    np.testing.assert_allclose((seen + 0.5) / 2.0, coarse + 0.5, atol=1e-9)


def test_without_other_programs_there_are_no_figures_but_reasons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(PEERS, raising=False)
    found = list(witness.measure(Run(False, lambda words: None, 1, tmp_path)))
    figures = {one.name: one for one in found if isinstance(one, Figure)}
    for name in ("shape_over_own", "displacement_over_own", "strain_over_own"):
        assert figures[name] == Figure(name, None, "1", 1.2, "at most")
    assert any(PEERS in one.text for one in found if isinstance(one, Condition))


def test_what_is_missing_is_said_before_anything_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PEERS, raising=False)
    said = inside("bench", "witness").stderr
    assert said.index(f"witness: figures will be left out: {PEERS} names no folder") < said.index("compiling")
    # An environment that has none of the programs: this one.
    monkeypatch.setenv(PEERS, sys.prefix)
    lacking = witness.GROUP.lacks()
    for program in ("Mitsuba", "riley"):
        assert f"{program} does not run: ModuleNotFoundError: No module named '{program.lower()}'" in lacking
