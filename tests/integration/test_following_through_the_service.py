"""Two cameras follow points by their own textures through the service: computed once, refused elsewhere."""

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
from sms_jobs.records.scene import Rigid, Simulation
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig
from sms_jobs.virtual_rig.truth import exact_truth

SHIFT = (Rigid((0.0, 0.0, 0.01), (0.5, -0.2, 0.3)),)
SUBSET_PX = 25
RIG = stereo_rig(240, 192)
CALIBRATION, MADE = stereo_campaign("followed", rig=RIG, deformations=(SHIFT,))
CAMPAIGN = replace(MADE, views=("C1C2", "C1"))


@pytest.fixture
def home(tmp_path: Path) -> Path:
    home = tmp_path / "home"
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, CAMPAIGN, CALIBRATION, datetime.now(UTC))
    return home


def test_points_are_followed_by_the_parameter(home: Path) -> None:
    about = ("-c", "followed", "--home", str(home))
    own = ("--set", "correlate.following=own-reference", *about)
    lab = sms_jobs.open(home)

    def files() -> list[str]:
        found = answer("data", "find", "--kind", "correlate", *about)
        return sorted(file["path"] for file in found)

    with service(home):
        answer("job", "submit", "simulate", "--wait", *about)
        answer("job", "submit", "stereo", "correlate", "--view", "C1C2", "--wait", *about)
        usual, before = lab.read("followed/S01/C1C2", "correlate"), files()
        answer("job", "submit", "stereo", "correlate", "--view", "C1C2", "--wait", *own)
        after = files()
        answer("job", "submit", "stereo", "correlate", "--view", "C1C2", "--wait", *own)
        refused = inside("job", "submit", "correlate", "--view", "C1", *own)
    # What was followed is another result, and is not made twice.
    assert len(set(after) - set(before)) == 1
    assert files() == after
    assert refused.returncode != 0
    assert "several cameras without a projector" in refused.stderr
    followed = lab.read("followed/S01/C1C2", "correlate")
    scene = MADE.scene
    assert scene is not None
    rest, moved = (Simulation(scene, "C1", "C2", s.deformation, state=s.label) for s in MADE.states)
    truth = exact_truth(rest, moved, ("C2",))
    both = [one["reason"].to_numpy() == 0 for one in (usual, followed)]
    # A rim of a spacing is lost at the most, on an object of some 150 x 120 px.
    assert both[1].sum() > 0.85 * both[0].sum()
    rms = []
    for one, valid in zip((usual, followed), both, strict=True):
        error = (one["displacement"].to_numpy() - truth.displacement)[:, valid]
        variance = one["covariance"].sel(covariance_component=["XX", "YY", "ZZ"]).to_numpy()[:, valid]
        # The mean square of n normal errors over their deviations scatters by sqrt(2 / n) about 1; n are the
        # subsets that lie side by side. Stated may be a fifth more or less than what is.
        drawn = 3.0 * valid.sum() / SUBSET_PX**2
        chance = 3.0 * np.sqrt(2.0 / drawn)
        assert 1.0 / 1.2**2 - chance < (error**2 / variance).mean() < 1.0 / 0.8**2 + chance
        rms.append(np.sqrt((error**2).sum(axis=0).mean()))
    # The motion turns nearly nothing, so that what cameras are matched with each other by cancels.
    assert rms[1] < rms[0]
