"""How long jobs will take, told from jobs of the past; the same on both deployments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from datetime import datetime, timedelta

import pytest
from sqlalchemy import event, select, update
from support.deployments import Deployment
from support.jobs import JOBS, NOW, accept_calibration, submit_pipeline

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.planning.chosen import by_ids
from sms_jobs.jobs.planning.estimates import ends, estimate, pace
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.running import orders, queues, recovery
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.estimates import Estimate
from sms_jobs.virtual_rig.campaigns import small_plate

SECONDS = {
    "simulate": 4.0,
    "reconstruct": 10.0,
    "correlate": 20.0,
    "strain": 3.0,
    "assess": 1.0,
    "merge": 2.0,
    "export": 1.0,
    "report": 5.0,
}


def add_campaign(catalogue: Catalogue, name: str, scale: int = 1) -> None:
    """Add the small plate as another campaign of a rig of its own, with so many times the pixels each way."""
    calibration, record = small_plate(name)
    larger = [replace(s, columns=scale * s.columns, rows=scale * s.rows) for s in calibration.rig.sensors]
    with catalogue.writing() as session:
        campaigns.add_campaign(session, replace(record, rig=f"rig-{name}"), NOW)
        file = FileRow(
            source="calibration",
            path=f"calibrations/{name}.h5",
            content_hash=name,
            size_bytes=1,
            media_type="application/x-hdf5",
            created_at=NOW,
        )
        session.add(file)
        session.flush()
        rig = replace(calibration.rig, name=f"rig-{name}", sensors=tuple(larger))
        accept_calibration(session, replace(calibration, rig=rig), file.id)


def submitted(catalogue: Catalogue, name: str, *kinds: str, priority: int = 0) -> tuple[str, ...]:
    with catalogue.writing() as session:
        return submit(session, name, [Request(kind) for kind in kinds], NOW, Terms(priority=priority)).job_ids


def let_all_succeed(
    catalogue: Catalogue, seconds: Mapping[str, float] = SECONDS, worker: str = "w1", at: datetime = NOW
) -> None:
    """End every active job as if it had run."""
    with catalogue.writing() as session:
        active = select(JobRow).where(JobRow.state.in_((JobState.WAITING, JobState.QUEUED)))
        for job in session.scalars(active).all():
            job.state, job.worker_id = JobState.SUCCEEDED, worker
            job.started_at, job.finished_at = at, at + timedelta(seconds=seconds[job.kind])


def told(catalogue: Catalogue, job_ids: Sequence[str], at: datetime = NOW, workers: int = 2) -> Estimate:
    with catalogue.reading() as session:
        return estimate(session, by_ids(job_ids), at, workers)


def test_without_history_nothing_is_told_but_what_is_missing(catalogue: Catalogue) -> None:
    ahead = told(catalogue, submit_pipeline(catalogue))
    assert (ahead.seconds, ahead.ready_at) == (None, None)
    assert sum(ahead.unknown.values()) == ahead.jobs == JOBS


def test_a_kind_without_history_leaves_a_lower_bound(catalogue: Catalogue) -> None:
    add_campaign(catalogue, "plate")
    submitted(catalogue, "plate", "simulate")
    let_all_succeed(catalogue)
    ahead = told(catalogue, submitted(catalogue, "plate", "simulate", "reconstruct"))
    assert ahead.unknown == {"reconstruct": 4}
    # Two states, recorded by two workers at the same time.
    assert ahead.seconds == SECONDS["simulate"]


def test_what_is_remembered_is_read_again_once_another_job_has_succeeded(catalogue: Catalogue) -> None:
    add_campaign(catalogue, "plate")
    takes = []
    for factor in (1, 3, 3):
        submitted(catalogue, "plate", "simulate")
        later = NOW + timedelta(hours=len(takes))
        let_all_succeed(catalogue, {"simulate": factor * SECONDS["simulate"]}, at=later)
        new = submitted(catalogue, "plate", "simulate")
        takes.append(told(catalogue, new, later).seconds)
        assert told(catalogue, new, later).seconds == takes[-1]
        with catalogue.writing() as session:
            for job in new:
                orders.cancel(session, job, later, "")
    # The median of as many jobs that took once as long and thrice; then most took thrice as long.
    assert takes == [factor * SECONDS["simulate"] for factor in (1, 2, 3)]


def test_the_longest_chain_and_the_shared_work_are_both_respected(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    let_all_succeed(catalogue)
    ids = submitted(catalogue, "plate", "simulate", "pipeline")
    by_workers = []
    for workers in (1, 2, 3, 100):
        with catalogue.writing() as session:
            session.execute(update(WorkerRow).values(concurrency=workers))
        ahead = told(catalogue, ids)
        assert ahead.seconds is not None
        assert ahead.ready_at == NOW + timedelta(seconds=ahead.seconds)
        assert (ahead.workers, ahead.alive, ahead.unknown) == (workers, True, {})
        by_workers.append(ahead.seconds)
    with catalogue.reading() as session:
        kinds = [session.get_one(JobRow, job_id).kind for job_id in ids]
    assert by_workers[0] == pytest.approx(sum(SECONDS[kind] for kind in kinds))
    chain = ("simulate", "reconstruct", "correlate", "strain", "merge", "report")
    assert by_workers[-1] == pytest.approx(sum(SECONDS[kind] for kind in chain))
    assert by_workers == sorted(by_workers, reverse=True)


def test_larger_images_take_longer_in_proportion(catalogue: Catalogue) -> None:
    add_campaign(catalogue, "small")
    add_campaign(catalogue, "large", scale=2)
    submitted(catalogue, "small", "simulate")
    let_all_succeed(catalogue)
    ids = submitted(catalogue, "large", "simulate")
    assert told(catalogue, ids).seconds == 4 * SECONDS["simulate"]
    # Its own history is better than any that is scaled.
    let_all_succeed(catalogue, {"simulate": 9.0})
    assert told(catalogue, submitted(catalogue, "large", "simulate")).seconds == 9.0


def test_what_was_measured_on_this_host_is_preferred_and_one_that_hung_does_not_count(
    catalogue: Catalogue,
) -> None:
    with catalogue.writing() as session:
        # A worker of another host, which has long gone.
        recovery.register_worker(session, "w2", "there", 1, ["cpu"], 4, NOW - timedelta(days=1))
    add_campaign(catalogue, "plate")
    for worker, seconds in (("w2", 100.0), ("w1", 4.0), ("w1", 5.0), ("w1", 3600.0)):
        submitted(catalogue, "plate", "simulate")
        let_all_succeed(catalogue, {"simulate": seconds}, worker)
    assert told(catalogue, submitted(catalogue, "plate", "simulate")).seconds == 5.0


def test_jobs_that_come_before_take_their_share(catalogue: Catalogue) -> None:
    add_campaign(catalogue, "plate")
    add_campaign(catalogue, "urgent")
    submitted(catalogue, "plate", "simulate")
    submitted(catalogue, "urgent", "simulate")
    let_all_succeed(catalogue)
    urgent = submitted(catalogue, "urgent", "simulate", priority=1)
    plate = submitted(catalogue, "plate", "simulate")
    assert told(catalogue, urgent).seconds == 4.0
    assert told(catalogue, plate).seconds == 8.0
    assert told(catalogue, [*urgent, *plate]).seconds == 8.0


def test_a_running_job_counts_with_what_is_left_of_it(catalogue: Catalogue) -> None:
    add_campaign(catalogue, "plate")
    submitted(catalogue, "plate", "simulate")
    let_all_succeed(catalogue)
    ids = submitted(catalogue, "plate", "simulate")
    with catalogue.writing() as session:
        session.execute(
            update(JobRow)
            .where(JobRow.id.in_(ids))
            .values(state=JobState.RUNNING, started_at=NOW, progress=0.5)
        )
    assert told(catalogue, ids, NOW + timedelta(seconds=1)).seconds == SECONDS["simulate"] - 1.0
    # It takes longer than any before: then half of it needs as long as the first half did.
    assert told(catalogue, ids, NOW + timedelta(seconds=30)).seconds == 30.0


def test_each_running_job_has_an_end_as_far_as_it_can_be_told(catalogue: Catalogue) -> None:
    def ends_at(seconds: float, at_most: int = 9) -> dict[str, datetime]:
        with catalogue.reading() as session:
            return ends(session, NOW + timedelta(seconds=seconds), at_most)

    assert ends_at(0.0) == {}
    add_campaign(catalogue, "plate")
    first, second = submitted(catalogue, "plate", "simulate")
    with catalogue.writing() as session:
        for after, (job, progress) in enumerate({first: 0.5, second: 0.0}.items()):
            began = NOW + timedelta(seconds=after)
            values = {"state": JobState.RUNNING, "started_at": began, "progress": progress}
            session.execute(update(JobRow).where(JobRow.id == job).values(values))
    # Such jobs never ended here: of the one that says how far it has come it is known, of the other not.
    assert ends_at(10.0) == {first: NOW + timedelta(seconds=20)}
    assert ends_at(10.0, at_most=1) == {}
    submitted(catalogue, "plate", "simulate")
    let_all_succeed(catalogue, {"simulate": 30.0})
    assert ends_at(10.0) == {
        job: NOW + timedelta(seconds=30 + after) for after, job in enumerate((first, second))
    }


def test_who_could_run_them_is_said(catalogue: Catalogue) -> None:
    add_campaign(catalogue, "plate")
    submitted(catalogue, "plate", "simulate")
    let_all_succeed(catalogue)
    ids = submitted(catalogue, "plate", "simulate")
    much_later = NOW + timedelta(hours=1)
    ahead = told(catalogue, ids, much_later, workers=1)
    assert (ahead.alive, ahead.workers, ahead.seconds) == (False, 1, 8.0)
    with catalogue.writing() as session:
        queues.pause(session, "acquisition", "no light", NOW)
        recovery.register_worker(session, "w2", "there", 1, ["cpu"], 4, much_later)
    ahead = told(catalogue, ids, much_later, workers=1)
    assert (ahead.unserved, ahead.paused, ahead.seconds) == (("acquisition",), ("acquisition",), None)


def test_the_pace_is_that_of_the_last_minutes_without_what_was_reused(catalogue: Catalogue) -> None:
    add_campaign(catalogue, "plate")
    old = submitted(catalogue, "plate", "simulate")
    let_all_succeed(catalogue, at=NOW - timedelta(hours=1))
    new = submitted(catalogue, "plate", "simulate")
    with catalogue.reading() as session:
        assert pace(session, by_ids(new), NOW) is None
    let_all_succeed(catalogue)
    both = [*old, *new]
    with catalogue.reading() as session:
        # Two jobs in the last ten minutes; since its first start, less than a minute ago, of the new ones.
        assert pace(session, by_ids(both), NOW + timedelta(seconds=30)) == pytest.approx(2 / 10)
        assert pace(session, by_ids(new), NOW + timedelta(seconds=30)) == pytest.approx(2 / 0.5)
        assert pace(session, by_ids(new), NOW + timedelta(hours=1)) is None
    with catalogue.writing() as session:
        session.execute(update(JobRow).where(JobRow.id == new[0]).values(reused_from=old[0]))
        assert pace(session, by_ids(new), NOW + timedelta(seconds=30)) == pytest.approx(1 / 0.5)


def test_jobs_that_end_while_one_asks_are_no_error(catalogue: Catalogue, deployment: Deployment) -> None:
    add_campaign(catalogue, "plate")
    ids = submitted(catalogue, "plate", "simulate")
    with closing(deployment.catalogue()) as other, ThreadPoolExecutor(1) as pool:
        asked = [0]

        def all_end(*_: object) -> None:
            asked[0] += 1
            if asked[0] == 1:
                pool.submit(let_all_succeed, other).result()

        event.listen(catalogue.engine, "after_cursor_execute", all_end)
        try:
            told(catalogue, ids)
        finally:
            event.remove(catalogue.engine, "after_cursor_execute", all_end)
    assert asked[0] > 1
    assert told(catalogue, ids).jobs == 0
