"""Schedules fire once each, whoever looks and however late, on both databases."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest
from sqlalchemy import select, update
from support.jobs import JOBS, NOW, REQUESTS, submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.schedules import ScheduleFireRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.scheduling import firing, schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression
from sms_jobs.jobs.scheduling.firing import Fired
from sms_jobs.jobs.scheduling.schedules import MissedFire, Order
from sms_jobs.records.job import JobState

HOUR = timedelta(hours=1)
ORDER = Order("plate", tuple(REQUESTS))
SUBMITTED = f"submitted {JOBS} jobs"


def add(catalogue: Catalogue, text: str, order: Order = ORDER, missed_fire: MissedFire = "once") -> None:
    schedules.add(catalogue, "nightly", parse_expression(text, "UTC"), order, NOW, missed_fire=missed_fire)


def fire(catalogue: Catalogue, hours: float) -> list[Fired]:
    return firing.fire_due(catalogue, NOW + hours * HOUR)


def outcomes(catalogue: Catalogue, hours: float) -> list[str]:
    return [one.outcome for one in fire(catalogue, hours)]


def test_each_time_submits_once(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    add(catalogue, "every 1h")
    assert outcomes(catalogue, 0.99) == []
    assert outcomes(catalogue, 1.0) == [SUBMITTED]
    assert outcomes(catalogue, 1.01) == []
    assert outcomes(catalogue, 2.0) == [SUBMITTED]
    with catalogue.reading() as session:
        assert sum(inquiry.counts(session).values()) == 3 * JOBS
        (view,) = schedules.schedules(session, NOW + 2.5 * HOUR)
    assert (view.last_outcome, view.next_fire) == (SUBMITTED, NOW + 3 * HOUR)


def test_a_clock_that_was_ahead_and_is_set_back_stops_nothing_and_repeats_nothing(
    catalogue: Catalogue,
) -> None:
    submit_pipeline(catalogue)
    add(catalogue, "every 1h", missed_fire="skip")
    assert outcomes(catalogue, 1.0) == [SUBMITTED]
    assert outcomes(catalogue, 5.01) == ["missed"] * 3 + [SUBMITTED]
    # For an hour, and then for a year: the times that have come and gone are not there again.
    assert [outcomes(catalogue, hours) for hours in (4.2, 5.0, 5.5, 6.0)] == [[], [], [], [SUBMITTED]]
    assert outcomes(catalogue, 365 * 24.0)[-1] == SUBMITTED
    assert [outcomes(catalogue, hours) for hours in (6.5, 7.0, 7.5, 8.0)] == [
        [],
        [SUBMITTED],
        [],
        [SUBMITTED],
    ]


@pytest.mark.parametrize(
    ("policy", "late", "on_time"),
    [
        ("skip", ["missed"] * 3, ["missed"] * 3 + [SUBMITTED]),
        ("once", ["missed", "missed", SUBMITTED], ["missed"] * 3 + [SUBMITTED]),
        ("all", [SUBMITTED] * 3, [SUBMITTED] * 4),
    ],
)
def test_times_that_nobody_saw_follow_the_policy(
    catalogue: Catalogue, policy: MissedFire, late: list[str], on_time: list[str]
) -> None:
    submit_pipeline(catalogue)
    add(catalogue, "every 1h", missed_fire=policy)
    # Three times are past by more than the grace of five minutes, and none is due now.
    assert outcomes(catalogue, 3.5) == late
    with catalogue.writing() as session:
        schedules.remove(session, "nightly")
    add(catalogue, "every 1h", missed_fire=policy)
    # The fourth is due now: with "once" the missed ones need no run of their own.
    assert outcomes(catalogue, 4.0) == on_time


def test_supervisors_that_look_at_once_submit_once(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    add(catalogue, "every 1h")
    with ThreadPoolExecutor(4) as pool:
        fired = [one for found in pool.map(lambda _: fire(catalogue, 1.0), range(4)) for one in found]
    assert [one.outcome for one in fired] == [SUBMITTED]
    with catalogue.reading() as session:
        assert len(session.scalars(select(ScheduleFireRow)).all()) == 1
        assert sum(inquiry.counts(session).values()) == 2 * JOBS


def test_one_that_waits_for_a_campaign_fires_once_when_its_jobs_have_ended(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    add(catalogue, "after plate")
    assert outcomes(catalogue, 1.0) == []
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(state=JobState.SUCCEEDED))
    assert outcomes(catalogue, 2.0) == [SUBMITTED]
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(state=JobState.SUCCEEDED))
    assert outcomes(catalogue, 3.0) == []


def test_a_paused_schedule_waits_and_a_removed_one_is_gone(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    add(catalogue, "every 1h", missed_fire="skip")
    with catalogue.writing() as session:
        schedules.set_paused(session, "nightly", True)
    assert outcomes(catalogue, 1.0) == []
    with catalogue.writing() as session:
        schedules.set_paused(session, "nightly", False)
    assert outcomes(catalogue, 2.0) == ["missed", SUBMITTED]
    with catalogue.writing() as session:
        schedules.remove(session, "nightly")
        assert schedules.schedules(session, NOW) == []
    with catalogue.reading() as session:
        assert sum(inquiry.counts(session).values()) == 2 * JOBS


def test_a_submission_that_fails_says_why_and_the_next_one_is_tried(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(state=JobState.SUCCEEDED))
    # Strains alone need displacements, of which the catalogue has no file.
    add(catalogue, "every 1h", Order("plate", (Request("strain"),)))
    (first,) = outcomes(catalogue, 1.0)
    assert first.startswith("failed: strain plate/S01")
    assert len(outcomes(catalogue, 2.0)) == 1


@pytest.mark.parametrize(
    ("text", "order", "error", "complaint"),
    [
        ("at 2026-02-28T12:00", ORDER, InvalidInput, "is past"),
        ("cron 0 0 30 2 *", ORDER, InvalidInput, "no time to come|no cron expression"),
        ("every 1h", Order("nowhere", tuple(REQUESTS)), NotFound, "no campaign 'nowhere'"),
        ("after nowhere", ORDER, NotFound, "no campaign 'nowhere'"),
        ("every 1h", Order("plate", (Request("levitate"),)), InvalidInput, "levitate"),
        ("every 1h", Order("plate", (Request("strain", {"radius": 1}),)), InvalidInput, "radius"),
    ],
)
def test_an_impossible_schedule_is_refused_and_nothing_is_entered(
    catalogue: Catalogue, text: str, order: Order, error: type[Exception], complaint: str
) -> None:
    submit_pipeline(catalogue)
    with pytest.raises(error, match=complaint):
        add(catalogue, text, order)
    with catalogue.reading() as session:
        assert schedules.schedules(session, NOW) == []


@pytest.mark.parametrize(
    ("text", "first"),
    [
        ("at 2026-03-01T11:58", timedelta(minutes=-2)),
        ("at 2026-03-01T13:00", timedelta(hours=1)),
        ("every 2h", timedelta(hours=2)),
        ("after plate", None),
    ],
)
def test_it_is_known_when_a_schedule_fires_first(
    catalogue: Catalogue, text: str, first: timedelta | None
) -> None:
    submit_pipeline(catalogue)
    add(catalogue, text)
    with catalogue.reading() as session:
        expected = None if first is None else NOW + first
        assert schedules.first_fire(session, "nightly", NOW) == expected


def test_a_name_is_taken_once(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    add(catalogue, "every 1h")
    with pytest.raises(Conflict, match="nightly"):
        add(catalogue, "every 2h")


def test_an_empty_question_is_not_that_for_everything(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with pytest.raises(InvalidInput, match="the question is empty, so that every state of every campaign"):
        add(catalogue, "every 1h", Order("", tuple(REQUESTS), where=" "))
