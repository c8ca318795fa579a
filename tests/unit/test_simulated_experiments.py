"""Every experiment that can be asked for by name makes its campaigns, and they can be registered."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from support.homes import make_home

from sms_jobs import bootstrap
from sms_jobs.app.specimens.experiments import EXPERIMENTS, experiment_campaigns
from sms_jobs.catalogue import campaigns
from sms_jobs.jobs.archiving.registration import register_campaign


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_is_one_campaign_or_one_for_each_position(experiment: str) -> None:
    made = experiment_campaigns(experiment, "mine", "small")
    names = [campaign.name for _, campaign in made]
    assert names == (["mine-1", "mine-2", "mine-3"] if "wing-panel" in experiment else ["mine"])
    # Positions of a rig have states and views of the same names, on one rig and one specimen.
    assert len({tuple(s.label for s in campaign.states) for _, campaign in made}) == 1
    assert len({(campaign.views, campaign.rig, campaign.specimen) for _, campaign in made}) == 1
    assert all(campaign.scene is not None for _, campaign in made)


def test_positions_of_a_rig_are_registered_beside_each_other(tmp_path: Path) -> None:
    home = tmp_path / "home"
    make_home(home, {})
    with bootstrap.services(home) as services:
        for calibration, campaign in experiment_campaigns("wing-panel", "wing", "small"):
            register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
        with services.catalogue.reading() as session:
            placed = {
                name: campaigns.definition(campaigns.campaign_row(session, name)).scene
                for name in ("wing-1", "wing-2", "wing-3")
            }
    assert len({scene.placement for scene in placed.values() if scene is not None}) == 3
