"""A state that lacks something does not keep the others of its campaign from being computed."""

from __future__ import annotations

import json
from collections import Counter
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select
from support.command import inside
from support.homes import make_home
from support.jobs import NOW

from sms_jobs import bootstrap
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.scheduling import firing, schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression
from sms_jobs.jobs.scheduling.schedules import Order

LACKING = "S01"


@pytest.fixture
def recorded(home: Path) -> Path:
    """A home whose campaign was recorded in all states but one, by what its catalogue says."""
    make_home(home, {})
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        campaign = session.scalars(select(CampaignRow)).one()
        states = session.scalars(select(LoadStateRow).where(LoadStateRow.label != LACKING)).all()
        for number, (state, view) in enumerate((s, v) for s in states for v in campaign.views):
            file = FileRow(
                source="measurement",
                path=str(number),
                content_hash="",
                size_bytes=1,
                media_type=DATASET_MEDIA_TYPE,
                created_at=NOW,
                recorded_at=NOW + timedelta(days=10_000),
                campaign_id=campaign.id,
                state_id=state.id,
                view=view,
            )
            session.add(file)
            session.flush()
            session.add(
                MeasurementRow(file_id=file.id, state_id=state.id, view=view, recorded_at=file.recorded_at)
            )
    return home


def submitted(home: Path) -> Counter[tuple[str, str]]:
    """Return how many jobs there are by state and kind."""
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        jobs = session.execute(select(JobRow.subject, JobRow.kind)).all()
    return Counter((subject.split("/")[1] if "/" in subject else "", kind) for subject, kind in jobs)


def test_the_others_are_submitted_and_the_refused_one_is_named(recorded: Path) -> None:
    at = ("-c", "plate", "--home", str(recorded))
    tried = inside("job", "submit", "pipeline", "--dry-run", *at)
    assert (tried.returncode, submitted(recorded)) == (6, Counter())
    done = inside("job", "submit", "pipeline", *at)
    assert done.returncode == 6
    refused = [line for line in done.stderr.splitlines() if line.startswith("refused: ")]
    assert refused == [line for line in tried.stderr.splitlines() if line.startswith("refused: ")]
    assert f"refused: plate/{LACKING} (" in refused[0]
    assert f"needs the measurement of plate/{LACKING}/" in refused[0]
    assert "record or simulate it" in refused[0]
    assert refused[1].startswith("refused: plate (1 report): ")
    jobs = submitted(recorded)
    assert {state for state, _ in jobs} == {"S00"}
    assert jobs["S00", "reconstruct"] > 0


def test_json_tells_of_both(recorded: Path) -> None:
    done = inside("job", "submit", "pipeline", "-c", "plate", "--json", "--home", str(recorded))
    told = json.loads(done.stdout)
    assert done.returncode == 6
    assert len(told["jobs"]) == submitted(recorded).total() > 0
    assert [one["subject"] for one in told["refused"]] == [f"plate/{LACKING}", "plate"]
    assert told["refused"][0]["jobs"]["merge"] == 1


def test_where_every_state_is_refused_nothing_is_submitted(recorded: Path) -> None:
    done = inside("job", "submit", "pipeline", "--state", LACKING, "-c", "plate", "--home", str(recorded))
    assert done.returncode == 3
    assert "needs the measurement" in done.stderr
    assert submitted(recorded) == Counter()


def test_a_gauge_length_in_pixels_that_no_view_takes_is_refused(recorded: Path) -> None:
    at = (
        "simulate",
        "pipeline",
        "-c",
        "plate",
        "--set",
        "strain.gauge_length_px=20",
        "--home",
        str(recorded),
    )
    for words in (("job", "submit"), ("schedule", "add", "nightly", "--every", "1h")):
        refused = inside(*words, *at)
        assert refused.returncode == 2
        assert "gauge_length_px is 20, which cameras alone take, and plate has none beside" in refused.stderr
    assert submitted(recorded) == Counter()
    # What is given in mm is what counts.
    both = inside("job", "submit", *at, "--set", "strain.gauge_length_mm=30", "--dry-run")
    assert "would submit" in both.stderr


def test_a_schedule_submits_the_others_and_tells(recorded: Path) -> None:
    order = Order("plate", (Request("pipeline"),))
    with bootstrap.services(recorded) as services:
        catalogue = services.catalogue
        schedules.add(catalogue, "nightly", parse_expression("every 1h", "UTC"), order, NOW)
        (fired,) = firing.fire_due(catalogue, NOW + timedelta(hours=1, minutes=1))
    assert f"jobs; refused plate/{LACKING} and 1 more: " in fired.outcome
    assert submitted(recorded).total() > 0
