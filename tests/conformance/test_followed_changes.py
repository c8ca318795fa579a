"""Changes of planned recordings, calibrations and schedules are noted with them, once, on both databases."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta

import pytest
from sqlalchemy import update
from support.archives import Clock, registered
from support.jobs import JOBS, NOW, REQUESTS, submit_pipeline

from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import Conflict
from sms_jobs.jobs.archiving import acceptances
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.jobs.monitoring import happenings
from sms_jobs.jobs.recording import due_recordings, planned_recordings
from sms_jobs.jobs.running import lifecycle
from sms_jobs.jobs.scheduling import firing, schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression
from sms_jobs.jobs.scheduling.schedules import Order
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.changes import Change
from sms_jobs.records.triggers import InTurn
from sms_jobs.virtual_rig.campaigns import small_plate

HOUR = timedelta(hours=1)


@contextmanager
def noted(catalogue: Catalogue) -> Iterator[list[Change]]:
    """Give, at the end of the block, the changes beside jobs that were noted in it."""
    found: list[Change] = []
    with catalogue.reading() as session:
        before = happenings.newest(session)
    yield found
    with catalogue.reading() as session:
        found += happenings.happened(session, before, 1000).changes


def states(found: list[Change]) -> list[tuple[str, str]]:
    return [(one.name, one.state) for one in found]


@pytest.fixture
def planned(catalogue: Catalogue) -> Catalogue:
    """A plan of three states, of which nothing is recorded."""
    _, campaign = small_plate("wing")
    labels = tuple(LoadState(f"S{n:02}", 100.0 * n) for n in range(3))
    with catalogue.writing() as session:
        campaigns.add_campaign(session, replace(campaign, states=labels), NOW)
        wanted = [(state.label, InTurn()) for state in labels]
        planned_recordings.put(session, "wing", wanted, "anna", NOW)
    return catalogue


def test_what_is_planned_is_told(planned: Catalogue) -> None:
    with planned.reading() as session:
        found = happenings.happened(session, happenings.Cursor(0, 0), 1000).changes
    assert states(found) == [(f"wing/S{n:02}", "planned") for n in range(3)]
    assert {(one.topic, one.campaign) for one in found} == {("recording", "wing")}


def test_what_people_do_to_a_plan_is_told_where_it_changes_something(planned: Catalogue) -> None:
    with noted(planned) as found:
        for held in (True, True, False):
            with planned.writing() as session:
                planned_recordings.set_held(session, "wing", ["S01"], held)
        with planned.writing() as session:
            planned_recordings.move(session, "wing", "S02", "S01")
        with planned.writing() as session:
            planned_recordings.skip(session, "wing", [])
        with planned.writing() as session:
            planned_recordings.drop(session, "wing", ["S01"])
    assert states(found) == [
        ("wing/S01", "held"),
        ("wing/S01", "released"),
        ("wing/S02", "moved"),
        ("wing/S00", "skipped"),
        ("wing/S01", "dropped"),
    ]


def test_what_is_refused_is_not_told(planned: Catalogue) -> None:
    with noted(planned) as found:
        with planned.writing() as session:
            planned_recordings.skip(session, "wing", ["S00"])
        with pytest.raises(Conflict), planned.writing() as session:
            planned_recordings.set_held(session, "wing", ["S01", "S00"], True)
    assert states(found) == [("wing/S00", "skipped")]


def test_a_recording_begins_and_is_recorded(planned: Catalogue) -> None:
    with planned.reading() as session:
        (one,) = due_recordings.due(session)
    with noted(planned) as found:
        job = due_recordings.begin(planned, one, NOW, NOW)
        assert due_recordings.begin(planned, one, NOW, NOW) is None
        with planned.writing() as session:
            session.execute(update(JobRow).where(JobRow.id == job).values(state=JobState.SUCCEEDED))
        for _ in range(2):
            due_recordings.settle(planned)
    assert states(found) == [("wing/S00", "begun"), ("wing/S00", "recorded")]


def test_a_recording_that_breaks_off_is_told_as_its_job_is(planned: Catalogue) -> None:
    with planned.reading() as session:
        (one,) = due_recordings.due(session)
    job = due_recordings.begin(planned, one, NOW, NOW)
    assert job is not None
    with noted(planned) as found:
        for state in (JobState.NEEDS_OPERATOR, JobState.FAILED):
            with planned.writing() as session:
                session.execute(update(JobRow).where(JobRow.id == job).values(state=JobState.RUNNING))
            with planned.writing() as session:
                assert lifecycle.change(session, job, state, NOW, "no light")
        with planned.writing() as session:
            lifecycle.change_some(session, [job], JobState.QUEUED, NOW, "again")
        with planned.writing() as session:
            lifecycle.change_some(session, [job], JobState.CANCELLED, NOW, "by anna")
    assert [(one.name, one.state, one.message) for one in found] == [
        ("wing/S00", "needs-operator", "no light"),
        ("wing/S00", "failed", "no light"),
        ("wing/S00", "cancelled", "by anna"),
    ]


def test_a_calibration_is_entered_accepted_and_withdrawn(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    calibration, _ = small_plate("plate")
    later = replace(calibration, valid_from=calibration.valid_from + HOUR)
    with noted(catalogue) as found:
        register_calibration(catalogue, archive, later, clock())
        for campaign in (None, "plate"):
            for in_use in (True, True, False):
                acceptances.accept(catalogue, archive, 2, campaign, clock(), in_use=in_use)
    rig = calibration.rig.name
    assert [(one.state, one.campaign, one.message) for one in found if one.name == "2"] == [
        ("entered", "", f"of rig {rig}"),
        ("accepted", "", f"for rig {rig}"),
        ("withdrawn", "", f"for rig {rig}"),
        ("accepted", "plate", "for campaign plate"),
        ("withdrawn", "plate", "for campaign plate"),
    ]
    assert {one.topic for one in found} == {"calibration"}


def test_a_schedule_fires_misses_fails_and_is_held(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    order = Order("plate", tuple(REQUESTS))
    with noted(catalogue) as found:
        schedules.add(catalogue, "night", parse_expression("every 1h", "UTC"), order, NOW, missed_fire="skip")
        for hours in (1.0, 1.0, 2.5):
            firing.fire_due(catalogue, NOW + hours * HOUR)
        for paused in (True, True, False):
            with catalogue.writing() as session:
                schedules.set_paused(session, "night", paused)
        with catalogue.writing() as session:
            schedules.remove(session, "night")
    assert [(one.name, one.campaign, one.state, one.message) for one in found] == [
        ("night", "plate", "added", ""),
        ("night", "plate", "fired", f"submitted {JOBS} jobs"),
        ("night", "plate", "missed", "missed"),
        ("night", "plate", "paused", ""),
        ("night", "plate", "resumed", ""),
        ("night", "plate", "removed", ""),
    ]
