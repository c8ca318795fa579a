"""What the job service promises, on SQLite and on PostgreSQL alike."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from itertools import product

import pytest
from sqlalchemy import select, update
from support.jobs import JOBS, NOW, claim, events, ids, state, submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import OutboxRow
from sms_jobs.errors import Cancelled, Conflict, LeaseLost
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning import chosen
from sms_jobs.jobs.running import doorbell, lifecycle, orders, queues, recovery
from sms_jobs.records.job import ACTIVE, TRANSITIONS, JobState


def test_a_submission_is_whole_and_rings_for_what_can_run(catalogue: Catalogue) -> None:
    submitted = submit_pipeline(catalogue)
    with catalogue.reading() as session:
        rung = set(session.scalars(select(OutboxRow.job_id)))
        queued = set(session.scalars(select(JobRow.id).where(JobRow.state == JobState.QUEUED)))
        told = set(session.scalars(select(EventRow.job_id)))
    assert rung == queued != set()
    assert told == set(submitted)


def test_nothing_of_a_submission_remains_when_it_is_rolled_back(catalogue: Catalogue) -> None:
    class Interrupted(Exception):
        pass

    with pytest.raises(Interrupted):
        submit_pipeline(catalogue, fail_with=Interrupted())
    with catalogue.reading() as session:
        assert inquiry.counts(session) == {}
        assert session.scalars(select(OutboxRow)).all() == []


def test_jobs_run_only_after_what_they_need(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    finished: set[str] = set()
    while (held := claim(catalogue)) is not None:
        with catalogue.writing() as session:
            assert set(ids(session, held.job_id)) <= finished
            assert lifecycle.succeed(session, held, NOW, "done", reuse_key=held.job_id)
        finished.add(held.job_id)
    with catalogue.reading() as session:
        assert inquiry.counts(session) == {"succeeded": JOBS}


def test_eight_workers_never_claim_the_same_job(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)

    def work(_: int) -> list[str]:
        claimed = []
        while (held := claim(catalogue)) is not None:
            claimed.append(held.job_id)
            with catalogue.writing() as session:
                assert lifecycle.succeed(session, held, NOW, "done", reuse_key=held.job_id)
        return claimed

    # A worker that finds nothing to do may leave before others have queued more: rounds until all is done.
    claimed: list[str] = []
    with ThreadPoolExecutor(8) as pool:
        while True:
            round_of_claims = [job for jobs in pool.map(work, range(8)) for job in jobs]
            claimed += round_of_claims
            if not round_of_claims:
                break
    assert len(claimed) == len(set(claimed)) == JOBS


def test_higher_priority_runs_first_then_the_order_of_submission(catalogue: Catalogue) -> None:
    first = submit_pipeline(catalogue)
    urgent = submit_pipeline(catalogue, name="second", priority=5)
    held = claim(catalogue)
    assert held is not None
    assert held.job_id in urgent
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(priority=0))
    held = claim(catalogue)
    assert held is not None
    assert held.job_id in first


def test_a_draining_worker_claims_nothing(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        recovery.drain(session, "w1")
    assert claim(catalogue) is None


def test_a_superseded_attempt_can_write_nothing(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    late = claim(catalogue)
    assert late is not None
    with catalogue.writing() as session:
        assert recovery.recover(session, NOW, "w2", 3, set, silent=["w1"]) == [late.job_id]
        recovery.beat(session, "w1", NOW)
    newer = claim(catalogue)
    assert newer is not None
    assert newer.job_id == late.job_id
    assert newer.fence > late.fence
    with catalogue.writing() as session:
        assert not lifecycle.succeed(session, late, NOW, "done", reuse_key="late")
        with pytest.raises(LeaseLost):
            lifecycle.report_progress(session, late, 0.5, "half")
        assert not lifecycle.change(session, late.job_id, JobState.FAILED, NOW, "late", fence=late.fence)
        assert lifecycle.succeed(session, newer, NOW, "done", reuse_key="newer")


def test_a_job_is_judged_by_its_process_only_where_that_was_started(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        # Another supervisor has a process of that number, or none: neither tells it anything.
        for there in ({4711}, set[int]()):
            assert recovery.recover(session, NOW, "w2", 3, lambda there=there: there) == []
        assert recovery.recover(session, NOW, "w1", 3, lambda: {4711}) == []
        assert recovery.recover(session, NOW, "w1", 3, lambda: {1}) == [held.job_id]
    assert state(catalogue, held.job_id) is JobState.QUEUED
    assert [e.state for e in events(catalogue, held.job_id)] == ["queued", "running", "lost", "queued"]


def test_a_worker_that_was_given_up_claims_nothing_until_it_is_heard_again(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        assert recovery.recover(session, NOW, "w2", 3, set, silent=["w1"]) == []
    assert claim(catalogue) is None
    with catalogue.writing() as session:
        recovery.beat(session, "w1", NOW)
    assert claim(catalogue) is not None


def test_a_job_that_brings_its_worker_down_three_times_is_quarantined(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    first = claim(catalogue)
    assert first is not None
    for crash in range(3):
        if crash:
            again = claim(catalogue)
            assert again is not None
            assert again.job_id == first.job_id
        with catalogue.writing() as session:
            recovery.recover(session, NOW, "w1", 3, set)
    assert state(catalogue, first.job_id) is JobState.QUARANTINED
    with catalogue.reading() as session:
        said = inquiry.failure(session, chosen.of_campaign(session, "plate"))
    assert said.count(f"'sms job retry {first.job_id[:8]}'") == 1
    assert said.count(f"see 'sms job logs {first.job_id[:8]}'") == 1
    with catalogue.writing() as session:
        assert orders.retry(session, first.job_id, NOW) > 1
    assert state(catalogue, first.job_id) is JobState.QUEUED


def test_what_must_not_be_repeated_waits_for_an_operator(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(repeatable=False))
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        recovery.recover(session, NOW, "w1", 3, set)
        recovery.recover(session, NOW + timedelta(days=1), "w1", 3, set)
    assert state(catalogue, held.job_id) is JobState.NEEDS_OPERATOR


def test_a_failure_stops_only_what_depends_on_it_and_a_retry_brings_it_back(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        lifecycle.change(
            session, held.job_id, JobState.FAILED, NOW, "no light", fence=held.fence, error="no light"
        )
        counted = inquiry.counts(session)
    assert counted["failed"] == 1
    assert counted["skipped"] > 0
    assert counted["queued"] > 0
    with catalogue.writing() as session:
        assert orders.retry(session, held.job_id, NOW) == 1 + counted["skipped"]
        assert "skipped" not in inquiry.counts(session)
        with pytest.raises(Conflict, match="only a job that failed"):
            orders.retry(session, held.job_id, NOW)


def test_cancelling_stops_what_does_not_run_and_asks_what_does(catalogue: Catalogue) -> None:
    jobs = submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        lifecycle.report_progress(session, held, 0.1, "begun")
        assert orders.cancel(session, held.job_id, NOW)
        with pytest.raises(Cancelled, match="by an operator"):
            lifecycle.report_progress(session, held, 0.2, "going on")
        for job_id in jobs:
            if job_id != held.job_id:
                orders.cancel(session, job_id, NOW)
        assert set(inquiry.counts(session)) <= {"cancelled", "skipped", "running"}


def test_losing_every_message_loses_nothing(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        due = doorbell.unsent(session)
        doorbell.sent(session, due)
        assert doorbell.unsent(session) == []
        (again,) = doorbell.unheard(session)
        (call,) = doorbell.calls(due)
        assert (again.queue, again.number) == (call.queue, call.number) == ("acquisition", len(due))
        queues.pause(session, again.queue, "no more today", NOW)
        assert doorbell.unheard(session) == []


def test_only_changes_in_the_transition_table_are_made(catalogue: Catalogue) -> None:
    job_id = submit_pipeline(catalogue)[0]
    with catalogue.writing() as session:
        for start, target in product(JobState, JobState):
            session.execute(update(JobRow).where(JobRow.id == job_id).values(state=start))
            before = len(inquiry.events(session, job_id))
            changed = lifecycle.change(session, job_id, target, NOW, "trial")
            assert changed == (target in TRANSITIONS[start]), (start, target)
            assert len(inquiry.events(session, job_id)) == before + changed


def test_every_state_that_changes_by_itself_leads_to_an_end() -> None:
    reached = set(ACTIVE)
    for _ in JobState:
        reached |= {target for s in reached & set(ACTIVE) for target in TRANSITIONS[s]}
    assert JobState.SUCCEEDED in reached
    assert all(TRANSITIONS[s] for s in ACTIVE)
