"""A campaign that measures by fringes and by two cameras becomes one surface, one export, one report."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from support.command import answer, inside, service

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, Plane, Rigid, Scene, Simulation, Speckle, UniaxialStrain
from sms_jobs.records.sensors import Box, Rig
from sms_jobs.virtual_rig.campaigns import Lens, aimed, made, placed, small_plate
from sms_jobs.virtual_rig.truth import exact_truth

PIXELS = 160
SUBSET_PX = 21
LENS = Lens(7.0, -0.08, 0.1, 2e-4, -3e-4)
RIG = Rig(
    "mixed-rig",
    (
        aimed("C1", PIXELS, PIXELS, LENS, (-250.0, 50.0, 1230.0), 0.02),
        aimed("C2", PIXELS, PIXELS, LENS, (250.0, -50.0, 1230.0), -0.02),
        aimed("P1", 320, 240, Lens(5.0, -0.05, 0.1, 1e-4, 2e-4), (450.0, -100.0, 1150.0)),
    ),
)
SCENE = Scene(
    RIG,
    Plane(150.0, 150.0),
    Speckle(diameter_mm=5.6),
    placed((0.05, -0.03, 0.04), (1.0, -2.0, 3.0)),
    CameraResponse(exposure=0.9),
)
MOVED = (UniaxialStrain(0.005, 0.3), Rigid((0.001, -0.002, 0.003), (0.8, -0.5, 0.6)))
_, PLATE = small_plate("mixed")
CALIBRATION, WHOLE = made(
    "mixed",
    Box((-100.0, -100.0, -50.0), (100.0, 100.0, 50.0)),
    PLATE.specimen,
    (PLATE.states[0], replace(PLATE.states[1], deformation=MOVED)),
    FringeSequence((16, 15, 14, 12, 8)),
    SCENE,
)
CAMPAIGN = replace(WHOLE, views=("C1P1", "C1C2"))


@pytest.fixture
def home(tmp_path: Path) -> Path:
    home = tmp_path / "home"
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, CAMPAIGN, CALIBRATION, datetime.now(UTC))
    return home


def test_views_with_a_projector_and_without_merge(home: Path) -> None:
    with service(home):
        done = answer("job", "submit", "simulate", "pipeline", "-c", "mixed", "--wait", "--home", str(home))
    assert set(done["jobs"]) == {"succeeded"}
    lab = sms_jobs.open(home)
    merged = lab.read("mixed/S01", "merge")
    valid = merged["reason"].to_numpy() == 0
    contributors = merged["contributors"].to_numpy()
    fringes, stereo = (lab.read(f"mixed/S01/{view}", "correlate") for view in CAMPAIGN.views)
    own = [one["reason"].to_numpy() == 0 for one in (fringes, stereo)]
    # A pixel of the reference camera has what either view measured there, and both where both did.
    np.testing.assert_array_equal(contributors[valid], np.sum(own, axis=0)[valid])
    assert (contributors[valid] == len(CAMPAIGN.views)).mean() > 0.8
    rest, moved = (Simulation(SCENE, "C1", "P1", s.deformation, state=s.label) for s in CAMPAIGN.states)
    truth = exact_truth(rest, moved)
    error = (merged["displacement"].to_numpy() - truth.displacement)[:, valid]
    variance = merged["covariance"].sel(covariance_component=["XX", "YY", "ZZ"]).to_numpy()[:, valid]
    # So many subsets lie side by side, and the errors of each are drawn anew in three components: the mean
    # square of n normal errors over their deviations scatters by sqrt(2 / n) about 1.
    drawn = 3.0 * valid.sum() / SUBSET_PX**2
    assert abs((error**2 / variance).mean() - 1.0) < 3.0 * np.sqrt(2.0 / drawn)
    exported = answer("data", "find", "-c", "mixed", "--kind", "export", "--home", str(home))
    assert {file["subject"] for file in exported} == {"mixed/S01"}
    (report,) = answer("data", "find", "-c", "mixed", "--kind", "report", "--home", str(home))
    page = (home / "archive" / report["path"]).read_text()
    assert all(view in page for view in CAMPAIGN.views)


def test_gauges_off_the_surfaces_of_all_views_are_refused_and_no_others(home: Path) -> None:
    def submit(gauge: str) -> str:
        words = ("job", "submit", "gauges", "-c", "mixed", "--set", f"gauge={gauge}", "--dry-run")
        return inside(*words, "--home", str(home)).stderr

    kinds = ("simulate", "reconstruct", "stereo", "correlate")
    with service(home):
        answer("job", "submit", *kinds, "-c", "mixed", "--wait", "--home", str(home))
    far = submit("G x=0 y=0 length=20; far x=120 y=-10 length=20")
    assert "gauge far lies off the surface of C1P1: from its middle at x=120 y=-10 mm" in far
    assert "gauge G is in pixels, which only cameras alone read" in submit("G x=9px y=9px length=20px")
    assert "gauge G is 900 mm long and 450 mm wide" in submit("G x=0 y=0 length=900")
    assert "error" not in submit("G x=0 y=0 length=20")
