"""What is told of a test while it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy.orm import Session
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row, state_ids
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.asking.campaign_progress import progress_of
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.recording.recordings import unrecorded
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.state_progress import StateProgress
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign

NOW = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    initialised(tmp_path)
    with bootstrap.services(tmp_path) as made:
        calibration, campaign = small_plate("plate")
        register_campaign(made.catalogue, made.archive, campaign, calibration, NOW)
        yield made


def progress(services: Services) -> list[StateProgress]:
    with services.catalogue.reading() as session:
        return progress_of(session, "plate")


def add(
    session: Session,
    source: str,
    label: str,
    view: str,
    minutes: int,
    name: str = "plate",
    **statistics: float,
) -> None:
    """Enter a file into the catalogue, as an archived one is."""
    campaign = campaign_row(session, name)
    file = FileRow(
        source=source,
        path=f"{name}-{source}-{label}-{view}-{minutes}",
        content_hash="0" * 64,
        size_bytes=1,
        media_type="application/x-hdf5",
        created_at=NOW + timedelta(minutes=minutes),
        campaign_id=campaign.id,
        state_id=state_ids(session, campaign.id)[label],
        view=view,
    )
    session.add(file)
    session.flush()
    session.add_all(StatisticRow(file_id=file.id, name=n, value=v) for n, v in statistics.items())


def test_a_test_that_has_not_begun(services: Services) -> None:
    states = progress(services)
    assert [(s.label, s.load_n) for s in states] == [("S00", 0.0), ("S01", 1200.0)]
    assert all(s.recording == "" and s.views == 0 and s.displacement_mm is None for s in states)


def test_what_is_recorded_and_computed_is_told(services: Services) -> None:
    with services.catalogue.writing() as session:
        submit(session, "plate", [Request("acquire", {}, ())], NOW)
        first = session.query(JobRow).filter(JobRow.subject == "plate/S00").one()
        first.state = JobState.SUCCEEDED
        add(session, "measurement", "S00", "C1P1", 1, doubts=0.0, load_n_before=3.0)
        add(session, "measurement", "S00", "C1P2", 2, doubts=1.0, load_n_before=4.0)
    recorded, coming = progress(services)
    assert (recorded.recording, recorded.views, recorded.doubtful) == ("recorded", 2, 1)
    assert recorded.recorded_at == NOW + timedelta(minutes=2)
    assert recorded.channels == {"load_n": 4.0}
    assert (coming.recording, coming.views) == ("queued", 0)
    with services.catalogue.writing() as session:
        add(session, "correlate", "S01", "C1P1", 3, maximum_displacement_mm=9.0)
        add(session, "correlate", "S01", "C1P1", 4, maximum_displacement_mm=0.4)  # computed again
        add(session, "correlate", "S01", "C1P2", 5, maximum_displacement_mm=0.5)
        add(session, "strain", "S01", "C1P1", 6, maximum_principal_strain=2e-3)
    every = progress(services)
    assert (every[1].displacement_mm, every[1].strain) == (0.5, 2e-3)
    with services.catalogue.reading() as session:
        for chosen in (every[:1], every[1:], every):
            assert progress_of(session, "plate", [one.label for one in chosen]) == chosen


def test_the_last_job_of_its_kind_counts(services: Services) -> None:
    with services.catalogue.writing() as session:
        add(session, "measurement", "S00", "C1P1", 1, doubts=0.0)
        add(session, "measurement", "S00", "C1P2", 1, doubts=0.0)
        (failed,) = submit(session, "plate", [Request("reconstruct", {}, ("S00",), ("C1P1",))], NOW).job_ids
        session.get_one(JobRow, failed).state = JobState.FAILED
    assert (progress(services)[0].processing, progress(services)[0].failed) == (0, 1)
    with services.catalogue.writing() as session:
        submit(session, "plate", [Request("reconstruct", {}, ("S00",))], NOW)
    assert (progress(services)[0].processing, progress(services)[0].failed) == (2, 0)


def test_what_was_called_off_did_not_fail(services: Services) -> None:
    def submitted(kind: str, state: JobState) -> None:
        with services.catalogue.writing() as session:
            for job in submit(session, "plate", [Request(kind, {}, ("S00",))], NOW).job_ids:
                session.get_one(JobRow, job).state = state

    def told() -> tuple[str, int, int, int]:
        found = progress(services)[0]
        return found.recording, found.failed, found.skipped, found.cancelled

    with services.catalogue.writing() as session:
        add(session, "measurement", "S00", "C1P1", 1, doubts=0.0)
        add(session, "measurement", "S00", "C1P2", 1, doubts=0.0)
    submitted("reconstruct", JobState.CANCELLED)
    assert told() == ("recorded", 0, 0, 2)
    # Repeats that came to nothing, as of a schedule, take nothing away from what was done before.
    for state in (JobState.SUCCEEDED, JobState.CANCELLED, JobState.SKIPPED):
        for kind in ("acquire", "reconstruct"):
            submitted(kind, state)
        assert told() == ("recorded", 0, 0, 0)
    submitted("reconstruct", JobState.QUARANTINED)
    submitted("reconstruct", JobState.CANCELLED)
    assert told() == ("recorded", 2, 0, 0)
    submitted("simulate", JobState.SKIPPED)
    assert told() == ("recorded", 2, 1, 0)


def test_what_was_imported_is_recorded_and_judged_by_nobody(services: Services) -> None:
    with services.catalogue.writing() as session:
        add(session, "measurement", "S00", "C1", 1)
        add(session, "measurement", "S00", "C2", 2)
    found = progress(services)[0]
    assert (found.recording, found.views, found.judged, found.doubtful) == ("recorded", 2, 0, 0)
    assert found.recorded_at == NOW + timedelta(minutes=2)


def test_an_imported_image_does_not_stand_for_the_fringes_of_its_state(services: Services) -> None:
    with services.catalogue.writing() as session:
        add(session, "measurement", "S00", "C3", 1)
        assert unrecorded(session, "plate")[0].label == "S00"
        add(session, "measurement", "S00", "C1P1", 2)
        assert unrecorded(session, "plate")[0].label == "S01"


def test_a_state_of_several_cameras_is_recorded_when_all_of_them_are(services: Services) -> None:
    calibration, pair = stereo_campaign("pair")
    lit = replace(small_plate("lit")[1], views=("C1P1", "C1P2", "C2C3"), scene=None)
    register_campaign(services.catalogue, services.archive, pair, calibration, NOW)
    register_campaign(services.catalogue, services.archive, lit, None, NOW)

    def next_of(session: Session, name: str) -> str:
        return unrecorded(session, name)[0].label

    with services.catalogue.writing() as session:
        add(session, "measurement", "S00", "C1", 1, "pair")
        assert next_of(session, "pair") == "S00"
        add(session, "measurement", "S00", "C2", 2, "pair")
        assert next_of(session, "pair") == "S01"
        # Beside fringes either may have been imported without the other.
        for view, following in (("C1P1", "S00"), ("C2", "S00"), ("C3", "S01")):
            add(session, "measurement", "S00", view, 3, "lit")
            assert next_of(session, "lit") == following
