"""Names that differ only in case: none is given anew, and those that there are never overwrite each other."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from support.command import answer, inside
from support.homes import make_home, stored

from sms_jobs import bootstrap
from sms_jobs.catalogue import campaigns
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.calibration import Acceptance
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.virtual_rig.campaigns import small_plate

NOW = datetime(2026, 5, 4, tzinfo=UTC)
BOTH = (LoadState("S00"), LoadState("S01"), LoadState("s01"))


@pytest.fixture
def home(home: Path) -> Path:
    make_home(home, {})
    return home


def plate(name: str, *states: LoadState) -> Campaign:
    _, record = small_plate(name)
    return replace(record, states=states or record.states)


def test_no_campaign_and_no_state_is_given_such_a_name(home: Path) -> None:
    with bootstrap.services(home) as services:
        with pytest.raises(Conflict, match="'plate' already, from which 'Plate' differs only in case"):
            register_campaign(services.catalogue, services.archive, plate("Plate"), None, NOW)
        with pytest.raises(InvalidInput, match="states S01 and s01 of campaign other differ only in case"):
            register_campaign(services.catalogue, services.archive, plate("other", *BOTH), None, NOW)
    at = ("--home", str(home))
    refused = inside("campaign", "add-state", "plate", "s01", *at)
    assert refused.returncode == Conflict.exit_code
    assert "has a state S01 already, from which s01 differs only in case" in refused.stderr
    assert len(answer("campaign", "list", *at)) == 1


def test_an_export_of_both_is_refused_before_anything_is_written(home: Path, tmp_path: Path) -> None:
    at = ("--home", str(home))
    with bootstrap.services(home) as services:
        with services.catalogue.writing() as session:
            # As it was entered before, or comes from another archive.
            campaigns.add_campaign(session, plate("both", *BOTH), NOW)
        for number, state in enumerate(("S01", "s01")):
            stored(services, "gauges", f"both/{state}", {"some": Acceptance("rig", "0" * 64)}, number)
    export = ("data", "export", "--kind", "gauges", "-c", "both", "--as", "hdf5", "-o", str(tmp_path))
    refused = inside(*export, *at)
    assert refused.returncode == InvalidInput.exit_code
    assert "both-s01-gauges.h5 differ only in case" in refused.stderr
    assert "export each --state on its own" in refused.stderr
    assert not list(tmp_path.glob("*.h5"))
    assert inside(*export, "--state", "s01", *at).returncode == 0
    assert [one.name for one in tmp_path.glob("*.h5")] == ["both-s01-gauges.h5"]
    # What it has does not stand in the way of further states.
    assert inside("campaign", "add-state", "both", "S02", *at).returncode == 0
