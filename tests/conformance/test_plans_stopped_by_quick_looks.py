"""A plan waits for the quick look at a state with limits, and is held beyond them, on both databases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest
from sqlalchemy import select, update
from sqlalchemy.orm import Session
from support.jobs import NOW, add_calibration_file

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.notifications import OccurrenceRow
from sms_jobs.jobs.recording import due_recordings, planned_recordings, quick_looks, shown_plans
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.gauge_limits import GaugeLimit, Look
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.planned_recordings import PlannedRecording
from sms_jobs.records.subject import Subject
from sms_jobs.records.triggers import InTurn
from sms_jobs.virtual_rig.campaigns import small_plate

LABELS = [f"S{number:02d}" for number in range(4)]
VIEWS = ("C1P1", "C1P2")
LIMIT = GaugeLimit("g1", "extension_mm", True, 0.5)
QUANTITIES = ("extension", "x", "y", "z")


@pytest.fixture
def test_plan(catalogue: Catalogue) -> Catalogue:
    """A plan of four states, each with a limit; the first, the reference, is recorded."""
    _, campaign = small_plate("wing")
    states = tuple(LoadState(label, 100.0 * n) for n, label in enumerate(LABELS))
    gauges = {"gauges": {"gauge": "g1 x=0 y=0 length=60"}}
    with catalogue.writing() as session:
        campaigns.add_campaign(session, replace(campaign, states=states, processing=gauges), NOW)
        add_calibration_file(session, "wing")
        wanted = [(label, InTurn()) for label in LABELS]
        planned_recordings.put(session, "wing", wanted, "anna", NOW, look=Look(True, (LIMIT,)))
    record(catalogue, "S00")
    return catalogue


def record(catalogue: Catalogue, label: str) -> None:
    """Begin the recording that is due, and let it end well."""
    with catalogue.reading() as session:
        (one,) = due_recordings.due(session)
    assert one.label == label
    job = due_recordings.begin(catalogue, one, NOW, NOW)
    with catalogue.writing() as session:
        session.execute(update(JobRow).where(JobRow.id == job).values(state=JobState.SUCCEEDED))
        for view in VIEWS:
            add_file(session, "measurement", label, view, job)
    look(catalogue)


def add_file(session: Session, source: str, label: str, view: str, job: str | None) -> FileRow:
    number = campaigns.campaign_id(session, "wing")
    row = FileRow(
        source=source,
        path=f"wing/{label}/{view}/{source}.h5",
        content_hash=f"{source}{label}{view}",
        size_bytes=1,
        media_type="application/x-hdf5",
        created_at=NOW,
        campaign_id=number,
        state_id=campaigns.state_ids(session, number)[label],
        view=view,
        job_id=job,
    )
    session.add(row)
    session.flush()
    return row


def look(catalogue: Catalogue) -> None:
    """Do what the planner does every second."""
    due_recordings.settle(catalogue)
    quick_looks.judge(catalogue, NOW)


def looked(
    catalogue: Catalogue,
    label: str,
    extension_mm: float | None,
    views: tuple[str, ...] = VIEWS,
    state: JobState = JobState.SUCCEEDED,
) -> None:
    """Let the quick looks at a state end; without an extension they could not tell it."""
    for view in views:
        with catalogue.writing() as session:
            subject = str(Subject("wing", label, view))
            jobs = session.scalars(
                select(JobRow).where(JobRow.kind == "quick-look", JobRow.subject == subject)
            ).all()
            newest = max(jobs, key=lambda job: job.position)
            newest.state = state
            newest.error = "it was too dark" if state is JobState.FAILED else None
            found: Mapping[str, float] = {"gauges": 1.0, "gauges_read": 0.0}
            if extension_mm is not None:
                found = {f"g1_{name}_sigma_mm": 0.01 for name in QUANTITIES}
                found |= {f"g1_{name}_mm": extension_mm for name in QUANTITIES}
            file = add_file(session, "quick-look", label, view, newest.id)
            session.add_all(StatisticRow(file_id=file.id, name=k, value=v) for k, v in found.items())
    look(catalogue)


def due(catalogue: Catalogue) -> list[str]:
    with catalogue.reading() as session:
        return [one.label for one in due_recordings.due(session)]


def following(catalogue: Catalogue) -> PlannedRecording:
    with catalogue.reading() as session:
        return next(one for one in shown_plans.list_planned(session, NOW, "wing") if one.is_next)


def told(catalogue: Catalogue) -> list[tuple[str, str]]:
    with catalogue.reading() as session:
        rows = session.execute(select(OccurrenceRow.about, OccurrenceRow.message).order_by(OccurrenceRow.id))
        return [(about, message) for about, message in rows]


def test_the_reference_is_held_against_no_limit(test_plan: Catalogue) -> None:
    assert due(test_plan) == ["S01"]


def test_quick_looks_come_before_all_else_and_wait_for_their_recording(test_plan: Catalogue) -> None:
    record(test_plan, "S01")
    with test_plan.reading() as session:
        rows = session.execute(select(JobRow.kind, JobRow.priority, JobRow.parameters))
        found = {(kind, priority) for kind, priority, _ in rows}
    assert found == {("acquire", 0), ("quick-look", 100)}


def test_a_state_without_a_recorded_reference_is_looked_at_alone(catalogue: Catalogue) -> None:
    _, campaign = small_plate("wing")
    with catalogue.writing() as session:
        campaigns.add_campaign(session, campaign, NOW)
        add_calibration_file(session, "wing")
        planned_recordings.put(session, "wing", [("S01", InTurn())], "anna", NOW, look=Look(True))
    record(catalogue, "S01")
    with catalogue.reading() as session:
        rows = session.execute(
            select(JobRow.subject, JobRow.parameters).where(JobRow.kind == "quick-look")
        ).all()
    assert {(subject, given["alone"]) for subject, given in rows} == {
        ("wing/S01/C1P1", True),
        ("wing/S01/C1P2", True),
    }


def test_the_plan_waits_until_all_views_are_looked_at(test_plan: Catalogue) -> None:
    record(test_plan, "S01")
    looked(test_plan, "S01", 0.4, VIEWS[:1])
    assert (due(test_plan), following(test_plan).state) == ([], "S02")
    assert following(test_plan).waits_for.startswith("waits for the quick look at S01")
    looked(test_plan, "S01", 0.45, VIEWS[1:])
    assert (due(test_plan), told(test_plan)) == (["S02"], [])


def test_beyond_a_limit_the_plan_is_held_and_it_is_told_once(test_plan: Catalogue) -> None:
    record(test_plan, "S01")
    looked(test_plan, "S01", 0.62)
    look(test_plan)
    words = (
        "g1.extension_mm is 0.62 +- 0.01 mm in the quick look at S01/C1P1, and the plan stops where "
        "g1.extension_mm > 0.5 mm"
    )
    assert (due(test_plan), told(test_plan)) == ([], [("wing/S01", words)])
    assert following(test_plan).waits_for.startswith(f"it is held back: {words}; 'sms acquire plan go wing'")
    with test_plan.writing() as session:
        assert planned_recordings.set_held(session, "wing", [], False) == ["S02", "S03"]
    look(test_plan)
    assert (due(test_plan), following(test_plan).stopped_by) == (["S02"], "")
    # The next state is held against its limit anew.
    record(test_plan, "S02")
    looked(test_plan, "S02", 0.7)
    assert (due(test_plan), len(told(test_plan))) == ([], 2)


@pytest.mark.parametrize(
    ("state", "said"),
    [(JobState.SUCCEEDED, "no value of 1 gauge"), (JobState.FAILED, "it was too dark")],
)
def test_what_is_not_known_holds_the_plan_as_well(test_plan: Catalogue, state: JobState, said: str) -> None:
    record(test_plan, "S01")
    looked(test_plan, "S01", None, state=state)
    (words,) = [words for _, words in told(test_plan)]
    assert said in words
    assert words.endswith("and the plan stops where g1.extension_mm > 0.5 mm")
    assert due(test_plan) == []


def test_one_view_that_sees_the_gauge_is_enough(test_plan: Catalogue) -> None:
    record(test_plan, "S01")
    looked(test_plan, "S01", None, VIEWS[:1])
    looked(test_plan, "S01", 0.3, VIEWS[1:])
    assert (due(test_plan), told(test_plan)) == (["S02"], [])


def test_without_limits_the_plan_waits_for_no_look(test_plan: Catalogue) -> None:
    with test_plan.writing() as session:
        wanted = [(label, InTurn()) for label in LABELS[1:]]
        planned_recordings.put(session, "wing", wanted, "anna", NOW, look=Look(True))
    record(test_plan, "S01")
    assert due(test_plan) == ["S02"]
