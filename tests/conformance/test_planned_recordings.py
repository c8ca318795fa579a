"""Planned recordings begin once each, in their order, whoever looks, on both databases."""

from __future__ import annotations

import json
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timedelta

import pytest
from sqlalchemy import select, update
from support.jobs import NOW

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.planned import PlannedRecordingRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.recording import due_recordings, planned_recordings, shown_plans, watched_rigs
from sms_jobs.jobs.recording.due_recordings import Due
from sms_jobs.jobs.recording.recordings import requests
from sms_jobs.records import triggers
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.planned_recordings import Dropped, PlannedRecording
from sms_jobs.records.triggers import Counted, Every, Holding, InTurn, Trigger
from sms_jobs.virtual_rig.campaigns import small_plate

LABELS = [f"S{number:02d}" for number in range(4)]
MINUTE = timedelta(minutes=1)


@pytest.fixture
def test_plan(catalogue: Catalogue) -> Catalogue:
    """A catalogue with a campaign of four states, of which nothing is recorded."""
    _, campaign = small_plate("wing")
    states = tuple(LoadState(label, 100.0 * n) for n, label in enumerate(LABELS))
    with catalogue.writing() as session:
        campaigns.add_campaign(session, replace(campaign, states=states), NOW)
    return catalogue


def put(catalogue: Catalogue, *labels: str, trigger: Trigger | None = None, at: datetime = NOW) -> None:
    wanted = [(label, trigger or InTurn()) for label in labels]
    with catalogue.writing() as session:
        planned_recordings.put(session, "wing", wanted, "anna", at)


def shown(catalogue: Catalogue) -> list[PlannedRecording]:
    with catalogue.reading() as session:
        return shown_plans.list_planned(session, NOW, "wing")


def order(catalogue: Catalogue) -> list[str]:
    return [one.state for one in shown(catalogue)]


def statuses(catalogue: Catalogue) -> dict[str, str]:
    return {one.state: one.status for one in shown(catalogue)}


def due(catalogue: Catalogue) -> Due:
    with catalogue.reading() as session:
        (one,) = due_recordings.due(session)
    return one


def begin(catalogue: Catalogue, at: datetime = NOW) -> str | None:
    return due_recordings.begin(catalogue, due(catalogue), at, at)


def end(catalogue: Catalogue, job_id: str | None, state: JobState) -> None:
    with catalogue.writing() as session:
        session.execute(update(JobRow).where(JobRow.id == job_id).values(state=state))
    due_recordings.settle(catalogue)


def jobs(catalogue: Catalogue) -> list[str]:
    with catalogue.reading() as session:
        return list(session.scalars(select(JobRow.subject).where(JobRow.kind == "acquire")))


def test_each_begins_once_and_after_the_one_before_it(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    for label in LABELS:
        assert due(test_plan).label == label
        job = begin(test_plan)
        with test_plan.reading() as session:
            assert due_recordings.due(session) == []  # its recording is under way
        end(test_plan, job, JobState.SUCCEEDED)
    assert jobs(test_plan) == [f"wing/{label}" for label in LABELS]
    assert set(statuses(test_plan).values()) == {"recorded"}


def test_of_many_who_begin_it_at_once_one_does(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    one = due(test_plan)
    with ThreadPoolExecutor(4) as pool:
        begun = list(pool.map(lambda _: due_recordings.begin(test_plan, one, NOW, NOW), range(4)))
    assert len([job for job in begun if job is not None]) == 1
    assert jobs(test_plan) == ["wing/S00"]


def test_whoever_is_too_late_begins_nothing(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    one = due(test_plan)
    assert due_recordings.begin(test_plan, one, NOW, NOW) is not None
    assert due_recordings.begin(test_plan, one, NOW, NOW) is None
    assert jobs(test_plan) == ["wing/S00"]


def test_its_jobs_could_not_be_entered_twice(test_plan: Catalogue) -> None:
    put(test_plan, "S00")
    one, job = due(test_plan), begin(test_plan)
    # As if the claim had been forgotten, and the recording with it.
    with test_plan.writing() as session:
        session.execute(update(PlannedRecordingRow).values(status="planned", job_id=None))
        session.execute(update(JobRow).values(state=JobState.CANCELLED))
    with pytest.raises(SmsError):
        due_recordings.begin(test_plan, one, NOW, NOW)
    with test_plan.reading() as session:
        assert session.scalars(select(JobRow.id)).all() == [job]


def test_a_trigger_that_was_changed_meanwhile_begins_nothing(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    found = due(test_plan)
    put(test_plan, "S00", trigger=Every(600.0))
    assert due_recordings.begin(test_plan, found, NOW, NOW) is None
    found = due(test_plan)
    with test_plan.writing() as session:
        planned_recordings.set_held(session, "wing", [], True)
    assert due_recordings.begin(test_plan, found, NOW, NOW) is None
    with test_plan.writing() as session:
        planned_recordings.set_held(session, "wing", [], False)
        planned_recordings.move(session, "wing", "S03", "S00")
    assert due_recordings.begin(test_plan, found, NOW, NOW) is None
    assert (due(test_plan).label, jobs(test_plan)) == ("S03", [])


@pytest.mark.parametrize("state", [JobState.NEEDS_OPERATOR, JobState.FAILED, JobState.CANCELLED])
def test_what_breaks_off_is_waited_for_until_it_is_skipped(test_plan: Catalogue, state: JobState) -> None:
    put(test_plan, *LABELS)
    job = begin(test_plan)
    with test_plan.writing() as session, pytest.raises(Conflict, match="being recorded"):
        planned_recordings.skip(session, "wing", [])
    end(test_plan, job, state)
    with test_plan.reading() as session:
        assert due_recordings.due(session) == []
    (following,) = [one for one in shown(test_plan) if one.is_next]
    assert f"sms acquire resume {job}"[:25] in following.waits_for
    with test_plan.writing() as session:
        assert planned_recordings.skip(session, "wing", []) == ["S00"]
    assert due(test_plan).label == "S01"


def test_what_somebody_else_records_is_not_recorded_again(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    found = due(test_plan)
    with test_plan.writing() as session:
        submit(session, "wing", requests(("S00",), ask=False, process=False), NOW)
    with pytest.raises(Conflict, match="records wing/S00 already"):
        due_recordings.begin(test_plan, found, NOW, NOW)
    assert jobs(test_plan) == ["wing/S00"]


def test_what_came_in_otherwise_is_not_recorded_again(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    with test_plan.writing() as session:
        number = campaigns.campaign_id(session, "wing")
        session.add(
            FileRow(
                source="measurement",
                path="wing/S00/imported.h5",
                content_hash="imported",
                size_bytes=1,
                media_type="application/x-hdf5",
                created_at=NOW,
                campaign_id=number,
                state_id=campaigns.state_ids(session, number)["S00"],
                view="C1P1",
            )
        )
    due_recordings.settle(test_plan)
    assert (shown(test_plan)[0].status, shown(test_plan)[0].note) == ("recorded", "recorded outside the plan")
    assert (due(test_plan).label, jobs(test_plan)) == ("S01", [])


def test_the_plan_is_held_moved_and_dropped_while_it_goes_on(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    end(test_plan, begin(test_plan), JobState.SUCCEEDED)
    with test_plan.writing() as session:
        planned_recordings.move(session, "wing", "S03", "S01")
    assert order(test_plan) == ["S00", "S03", "S01", "S02"]
    with test_plan.writing() as session:
        planned_recordings.move(session, "wing", "S03", None)
        assert planned_recordings.set_held(session, "wing", ["S01"], True) == ["S01"]
    assert order(test_plan) == LABELS
    with test_plan.reading() as session:
        assert due_recordings.due(session) == []  # one that is held keeps those behind it back
    with test_plan.writing() as session:
        assert planned_recordings.drop(session, "wing", ["S01"]) == Dropped(("S01",))
        assert planned_recordings.set_held(session, "wing", [], True) == ["S02", "S03"]
        assert planned_recordings.set_held(session, "wing", [], False) == ["S02", "S03"]
    assert due(test_plan).label == "S02"
    begin(test_plan)
    with test_plan.writing() as session:
        assert planned_recordings.drop(session, "wing", []) == Dropped(("S03",), ("S00",), ("S02",))
    assert statuses(test_plan) == {"S02": "queued"}


def test_what_was_skipped_is_planned_again_at_the_end(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS)
    with test_plan.writing() as session:
        planned_recordings.skip(session, "wing", ["S00", "S02"])
    put(test_plan, "S00")
    assert order(test_plan) == ["S01", "S02", "S03", "S00"]
    with test_plan.reading() as session:
        # What was left out on purpose is not among what is left.
        left = due_recordings.plannable(session, "wing", ["S02"])
        assert [state.label for state in left] == ["S02"]
        with pytest.raises(Conflict, match="recorded, planned or skipped"):
            due_recordings.plannable(session, "wing")


def test_one_recording_follows_another_after_its_time(test_plan: Catalogue) -> None:
    put(test_plan, *LABELS, trigger=Every(600.0))
    one = due(test_plan)
    assert isinstance(one.trigger, Every)
    assert one.trigger.due(one.before, NOW) == NOW  # the first at once
    end(test_plan, begin(test_plan, NOW), JobState.SUCCEEDED)
    one = due(test_plan)
    assert isinstance(one.trigger, Every)
    assert one.trigger.due(one.before, NOW + 9.9 * MINUTE) is None
    assert one.trigger.due(one.before, NOW + 12.0 * MINUTE) == NOW + 10.0 * MINUTE
    # Nobody was there for half an hour: one is made up for, and the grid stays.
    assert one.trigger.due(one.before, NOW + 34.0 * MINUTE) == NOW + 30.0 * MINUTE


HOLDING = Holding("load_n", "N", 1000.0, 50.0, 10.0)
COUNTED = Counted("cycles", 1000, 5.0)


@pytest.mark.parametrize(
    ("trigger", "before", "after", "said"),
    [
        (HOLDING, (950.0, 960.0), (1040.0, 1050.0), None),
        (
            HOLDING,
            (990.0, 1000.0),
            (1000.0, 1051.0),
            r"read 990 to 1051 N, not load_n = 1000 \+- 50 N",
        ),
        (HOLDING, (949.0, 1000.0), (1000.0, 1000.0), "load_n read 949 to 1000 N"),
        (COUNTED, (1003.0, 1003.0), (1003.0, 1003.0), None),
        (COUNTED, (1003.0, 1003.0), (1003.0, 1004.0), "cycles read 1003 to 1004: it did not stand still"),
        (replace(COUNTED, for_s=0.0), (1003.0, 1003.0), (1009.0, 1009.0), None),
    ],
)
def test_what_was_not_recorded_as_planned_is_told(
    trigger: Holding | Counted, before: tuple[float, float], after: tuple[float, float], said: str | None
) -> None:
    name = trigger.channel
    found = due_recordings.doubt(trigger, {f"{name}_before": before, f"{name}_after": after})
    assert found is None if said is None else re.search(said, found or "")
    assert due_recordings.doubt(trigger, {}) == f"{name} was not read while it was recorded"


def test_triggers_are_kept_as_they_are() -> None:
    for trigger in (InTurn(), Every(900.0), HOLDING, COUNTED):
        assert triggers.from_json(json.loads(json.dumps(triggers.as_json(trigger)))) == trigger


def test_a_rig_that_somebody_wants_is_not_watched(test_plan: Catalogue) -> None:
    rig = "small-virtual-rig"
    with test_plan.writing() as session:
        assert watched_rigs.comes_first(session, rig, NOW, "w1") is None
        watched_rigs.hold(session, rig, "w1", NOW, MINUTE)
        assert watched_rigs.comes_first(session, rig, NOW, "w1") is None
        assert "'w1' has held" in (watched_rigs.comes_first(session, rig, NOW, "w2") or "")
        assert watched_rigs.comes_first(session, rig, NOW + 2 * MINUTE, "w2") is None  # w1 is gone
        submit(session, "wing", requests(("S00",), ask=False, process=False), NOW)
        assert "(acquire wing/S00) comes first" in (watched_rigs.comes_first(session, rig, NOW, "w1") or "")


@pytest.mark.parametrize(
    ("labels", "error", "complaint"),
    [
        (["S09"], InvalidInput, "has no state S09"),
        (["S00"], Conflict, "S00 of wing is recorded, or about to be"),
    ],
)
def test_what_cannot_be_recorded_is_refused(
    test_plan: Catalogue, labels: list[str], error: type[Exception], complaint: str
) -> None:
    with test_plan.writing() as session:
        submit(session, "wing", requests(("S00",), ask=False, process=False), NOW)
    with test_plan.reading() as session, pytest.raises(error, match=complaint):
        due_recordings.plannable(session, "wing", labels)


def test_what_is_not_planned_is_not_changed(test_plan: Catalogue) -> None:
    with test_plan.writing() as session:
        with pytest.raises(NotFound, match="no campaign 'tail'"):
            planned_recordings.skip(session, "tail", [])
        with pytest.raises(NotFound, match="nothing is planned of wing"):
            planned_recordings.set_held(session, "wing", [], True)
        with pytest.raises(NotFound, match="nothing is left"):
            planned_recordings.skip(session, "wing", [])
    put(test_plan, "S00", "S01")
    with test_plan.writing() as session:
        with pytest.raises(NotFound, match="nothing is planned of wing/S02; planned are S00, S01"):
            planned_recordings.drop(session, "wing", ["S02"])
        with pytest.raises(InvalidInput, match="before itself"):
            planned_recordings.move(session, "wing", "S00", "S00")
        planned_recordings.skip(session, "wing", ["S00"])
        with pytest.raises(Conflict, match="S00 is skipped"):
            planned_recordings.move(session, "wing", "S00", "S01")
