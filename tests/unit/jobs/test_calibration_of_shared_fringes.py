"""A campaign whose cameras share fringes needs a calibration of these cameras, and of no projector."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.specimens.campaigns import add_view
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.archiving import acceptances
from sms_jobs.jobs.archiving.registration import register_calibration, register_campaign
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.views import Role
from sms_jobs.virtual_rig.stereo_campaigns import shared_fringes_campaign

NOW = datetime(2026, 5, 4, tzinfo=UTC)


def test_what_is_recorded_and_measured_of_shared_fringes() -> None:
    _, made = shared_fringes_campaign("trio")
    campaign = replace(made, views=("C1C2P1", "C1P1", "C1C2", "C3"))
    assert campaign.recordings == ("C1P1", "C2P1", "C1", "C2", "C3")
    assert campaign.shape_views == ("C1C2P1", "C1P1", "C1C2")
    assert (campaign.fringe_views, campaign.camera_views) == (("C1P1",), ("C1C2",))
    assert campaign.stereo_fringe_views == ("C1C2P1",)
    assert campaign.cameras_alone == ("C3",)
    assert replace(campaign, views=("C1C2P1",)).shows_fringes
    assert not replace(campaign, views=("C1C2", "C3")).shows_fringes


def test_a_calibration_of_the_cameras_is_enough_for_what_they_share_and_for_nothing_else(
    tmp_path: Path,
) -> None:
    calibration, made = shared_fringes_campaign("trio")
    cameras = tuple(s for s in calibration.rig.sensors if s.role is Role.CAMERA)
    known = replace(calibration, rig=replace(calibration.rig, sensors=cameras))
    campaigns: dict[str, Campaign] = {
        name: replace(made, name=name, views=views)
        for name, views in (("shared", ("C1C2P1",)), ("paired", ("C1P1",)))
    }
    initialised(tmp_path)
    with bootstrap.services(tmp_path) as services:
        both = services.catalogue, services.archive
        for campaign in campaigns.values():
            register_campaign(*both, campaign, None, NOW)
        register_calibration(*both, known, NOW)
        acceptances.accept(*both, 1, "shared", NOW)
        with pytest.raises(Conflict, match=r"campaign paired is measured by P1 \(640 x 480 px\)"):
            acceptances.accept(*both, 1, "paired", NOW)
        with pytest.raises(InvalidInput, match=r"calibration 1, .* has no P1, and so no view C1P1"):
            add_view(services, "shared", "C1P1")
        assert add_view(services, "shared", "C2C1P1").views == ("C1C2P1", "C2C1P1")
