"""Holding queues back, changing the order, and ending jobs that take too much or do not stop."""

from __future__ import annotations

from datetime import timedelta
from itertools import count

import pytest
from support.jobs import NOW, claim, ids, state, submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import Cancelled, Conflict, OverLimit
from sms_jobs.jobs.asking import explanation
from sms_jobs.jobs.planning.chosen import by_ids
from sms_jobs.jobs.running import lifecycle, limits, orders, queues, recovery
from sms_jobs.jobs.running.limits import Force, Limits, Watch
from sms_jobs.records.job import JobState

GRACE = timedelta(seconds=15)
NO_LIMIT = Limits(None, None, GRACE)


def test_a_paused_queue_lets_nothing_begin_until_it_is_resumed(catalogue: Catalogue) -> None:
    first = submit_pipeline(catalogue)[0]
    with catalogue.writing() as session:
        queues.pause(session, "acquisition", "the hall is in use", NOW)
    assert claim(catalogue) is None
    with catalogue.writing() as session:
        (why,) = explanation.explain(session, session.get_one(JobRow, first), NOW)[1:]
        assert "the hall is in use" in why
        assert "sms queue resume acquisition" in why
        assert queues.resume(session, "acquisition")
        assert not queues.resume(session, "acquisition")
    assert claim(catalogue) is not None


def test_a_queue_that_waits_for_room_goes_on_by_itself_and_an_operators_pause_does_not(
    catalogue: Catalogue,
) -> None:
    with catalogue.writing() as session:
        queues.pause(session, "cpu", "maintenance", NOW)
        for name in queues.QUEUES:
            queues.pause(session, name, "the disk is full", NOW, for_room=True)
        queues.pause(session, "io", "maintenance too", NOW)
    with catalogue.writing() as session:
        assert queues.resume_for_room(session) == ["acquisition"]
        paused = {q.name: q.reason for q in queues.queues(session) if q.paused_at is not None}
    assert paused == {"cpu": "maintenance", "io": "maintenance too"}


def test_jobs_are_moved_before_and_behind_all_others(catalogue: Catalogue) -> None:
    first = submit_pipeline(catalogue)
    second = submit_pipeline(catalogue, name="second", priority=3)
    with catalogue.writing() as session:
        assert queues.move(session, by_ids(first), "front") == len(first)
    held = claim(catalogue)
    assert held is not None
    assert held.job_id in first
    with catalogue.writing() as session:
        assert queues.move(session, by_ids(first), "back") == len(first) - 1
        with pytest.raises(Conflict, match="already started or ended"):
            queues.move(session, by_ids([held.job_id]), "front")
    held = claim(catalogue)
    assert held is not None
    assert held.job_id in second


def test_moved_jobs_keep_the_order_among_themselves(catalogue: Catalogue) -> None:
    moved = submit_pipeline(catalogue)
    submit_pipeline(catalogue, name="second")
    for to in ("front", "back"):
        with catalogue.writing() as session:
            queues.move(session, by_ids(moved), "front" if to == "front" else "back")
            place = {i: session.get_one(JobRow, i).position for i in moved}
            for job_id in moved:
                assert all(place[needed] < place[job_id] for needed in ids(session, job_id))
        assert sorted(moved, key=lambda i: place[i]) == list(moved)


def test_priorities_are_given_to_jobs_that_have_not_begun(catalogue: Catalogue) -> None:
    first = submit_pipeline(catalogue)
    second = submit_pipeline(catalogue, name="second")
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        assert queues.set_priority(session, by_ids(second), 7) == len(second)
        assert queues.set_priority(session, by_ids(first), 9) == len(first) - 1
    held = claim(catalogue)
    assert held is not None
    assert held.job_id in first


@pytest.mark.parametrize(
    ("limit", "used_mb", "after", "complaint"),
    [
        (Limits(timedelta(seconds=60), None, GRACE), 1.0, 61.0, "60 s"),
        (Limits(None, 500.0, GRACE), 501.0, 1.0, "501 MB"),
    ],
)
def test_a_job_over_its_limit_is_asked_to_stop_and_fails(
    catalogue: Catalogue, limit: Limits, used_mb: float, after: float, complaint: str
) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    watch = Watch()

    def asked(seconds: float, memory_mb: float) -> list[str]:
        with catalogue.writing() as session:
            running = watch.look(session, "w1", seconds)
            return limits.ask_those_over_limit(session, running, NOW, limit, lambda pid: memory_mb)

    for seconds in range(int(after)):
        assert asked(seconds, used_mb - 1.0) == []
    assert asked(after, used_mb) == [held.job_id]
    assert asked(after, used_mb) == []
    with catalogue.writing() as session, pytest.raises(OverLimit, match=complaint):
        lifecycle.report_progress(session, held, 0.5, "half way")


def test_a_job_is_timed_by_who_watches_it_and_only_while_it_does(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    # The clock that wrote when it began was an hour behind.
    assert claim(catalogue, now=NOW - timedelta(hours=1)) is not None
    watch = Watch()
    with catalogue.reading() as session:
        assert [job.ran_s for job in watch.look(session, "w1", 100.0)] == [0.0]
        assert [job.ran_s for job in watch.look(session, "w1", 102.0)] == [2.0]
        # Whoever looks was stopped, or nobody could look: it is not the job that took so long.
        assert [job.ran_s for job in watch.look(session, "w1", 4000.0)] == [7.0]


def test_a_job_that_does_not_stop_is_terminated_then_killed_and_ends_as_asked(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    watch, clock = Watch(), count()

    def force(seconds: int) -> list[Force]:
        """Let so much time pass."""
        with catalogue.reading() as session:
            for _ in range(seconds):
                found = limits.overdue(watch.look(session, "w1", next(clock)), NO_LIMIT)
        return [job.force for job in found]

    assert force(100) == []
    with catalogue.writing() as session:
        assert orders.cancel(session, held.job_id, NOW)
        # Who asks later is not heard: neither the time nor the reason changes.
        assert orders.ask_to_stop(session, held.job_id, JobState.FAILED, NOW + GRACE, "too slow")
        with pytest.raises(Cancelled, match="by an operator"):
            lifecycle.report_progress(session, held, 0.5, "half way")
    assert force(15) == []
    assert force(1) == [Force.TERMINATE]
    assert force(15) == [Force.KILL]
    with catalogue.writing() as session:
        recovery.recover(session, NOW, "w1", 3, set)
    assert state(catalogue, held.job_id) is JobState.CANCELLED


def test_a_job_that_was_killed_for_its_limit_has_failed_and_can_be_retried(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        orders.ask_to_stop(session, held.job_id, JobState.FAILED, NOW, "took 9 GB")
        recovery.recover(session, NOW, "w1", 3, set)
        row = session.get_one(JobRow, held.job_id)
        assert (row.state, row.error) == (JobState.FAILED, "took 9 GB; its process was ended")
        assert orders.retry(session, held.job_id, NOW) > 1
    again = claim(catalogue)
    assert again is not None
    with catalogue.writing() as session:
        lifecycle.report_progress(session, again, 0.1, "begun")
        assert [job.asked_s for job in Watch().look(session, "w1", 0.0)] == [None]
