"""What is decided about a job that was given up stays decided, and a retry wakes only what can run then."""

from __future__ import annotations

from datetime import timedelta

import pytest
from support.jobs import NOW, claim, ids, state, submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.running import lifecycle, orders, recovery
from sms_jobs.records.job import UNSUCCESSFUL, JobState

LATER = NOW + timedelta(minutes=5)


@pytest.mark.parametrize("stopped", [True, False], ids=["stopped", "not-repeatable"])
def test_a_frozen_process_cannot_undo_what_was_decided(catalogue: Catalogue, stopped: bool) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        if stopped:
            orders.ask_to_stop(session, held.job_id, JobState.FAILED, NOW, "took too much")
        else:
            session.get_one(JobRow, held.job_id).repeatable = False
    with catalogue.writing() as session:
        assert recovery.recover(session, LATER, "w2", 3, set, silent=["w1"]) == [held.job_id]
    decided = JobState.FAILED if stopped else JobState.NEEDS_OPERATOR
    assert state(catalogue, held.job_id) is decided
    # It thaws, and its fence is still the newest: nobody has claimed the job since.
    for end in (JobState.QUEUED, JobState.CANCELLED, JobState.SUCCEEDED):
        with catalogue.writing() as session:
            assert not lifecycle.change(session, held.job_id, end, LATER, "late", fence=held.fence)
    assert state(catalogue, held.job_id) is decided


def test_a_retry_wakes_nothing_that_another_failure_holds_back(catalogue: Catalogue) -> None:
    submitted = submit_pipeline(catalogue)
    with catalogue.writing() as session:
        needs = {job_id: ids(session, job_id) for job_id in submitted}
        first, second = [job_id for job_id in submitted if not needs[job_id]][:2]
        assert orders.cancel(session, first, NOW)
        assert orders.cancel(session, second, NOW)
    with catalogue.writing() as session:
        woken = orders.retry(session, first, NOW)
        still = inquiry.counts(session)["skipped"]
        states = {job_id: session.get_one(JobRow, job_id).state for job_id in submitted}
    assert woken > 1
    assert still > 0
    # Nothing waits for what will not come.
    for job_id in submitted:
        if states[job_id] is JobState.WAITING:
            assert not any(states[needed] in UNSUCCESSFUL for needed in needs[job_id])
    with catalogue.writing() as session:
        assert orders.retry(session, second, NOW) == 1 + still
        assert set(inquiry.counts(session)) == {"queued", "waiting"}
