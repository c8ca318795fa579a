"""The life of jobs, driven at random against a model that is simple enough to be believed.

The deep form takes some minutes for ten thousand steps:

    bash ops/test.sh -m long tests/models/test_job_life_cycle_model.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    consumes,
    multiple,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import event, select, update
from support.deployments import Deployment
from support.job_model import HOSTS, QUEUES, Job, JobModel, Process, campaign
from support.sealing import provenance

from sms_jobs.archive import DATASET_MEDIA_TYPE, InputReference, Sealed
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import Cancelled, Conflict, LeaseLost, NotFound, OverLimit
from sms_jobs.jobs.archiving import indexing
from sms_jobs.jobs.archiving.indexing import Entry
from sms_jobs.jobs.planning.chosen import by_ids
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.results import reuse
from sms_jobs.jobs.running import doorbell, lifecycle, orders, queues, recovery
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.job import ACTIVE, TRANSITIONS, UNSUCCESSFUL, JobState
from sms_jobs.records.subject import Subject

BUDGET = 2
"""Crashes; fewer than in life, so that few steps exhaust it."""
WORK = [["simulate"], ["simulate", "reconstruct"], ["reconstruct", "correlate"], ["simulate", "pipeline"]]


class JobLives(JobModel):
    """Submits, claims, ends, loses, cancels, retries and orders jobs at random."""

    processes = Bundle("processes")

    @rule(
        kinds=st.sampled_from(WORK),
        part=st.booleans(),
        priority=st.integers(0, 2),
        use_cache=st.booleans(),
        real=st.booleans(),
    )
    @precondition(lambda self: len(self.jobs) < 45)
    def submit(self, kinds: list[str], part: bool, priority: int, use_cache: bool, real: bool) -> None:
        states = (campaign().states[0].label,) if part else ()
        requests = [Request(kind, states=states) for kind in kinds]
        self.now += timedelta(seconds=1)
        try:
            with self.catalogue.writing() as session:
                done = submit(
                    session, "plate", requests, self.now, Terms(priority=priority, use_cache=use_cache)
                )
                if real:
                    # As a recording on a real rig, which cannot be asked for twice.
                    recordings = JobRow.id.in_(done.job_ids), JobRow.kind == "simulate"
                    session.execute(update(JobRow).where(*recordings).values(repeatable=False))
        except NotFound:
            return
        with self.catalogue.reading() as session:
            rows = {row.id: row for row in session.scalars(select(JobRow).where(JobRow.id.in_(done.job_ids)))}
            edges = session.scalars(select(DependencyRow).where(DependencyRow.job_id.in_(done.job_ids))).all()
        for job_id in done.job_ids:
            producers = frozenset(e.producer_id for e in edges if e.job_id == job_id and e.producer_id)
            # Each needs only what comes before it, or what was on its way already.
            assert all(p in self.jobs and self.jobs[p].state in ACTIVE for p in producers)
            row = rows[job_id]
            first = JobState.WAITING if producers else JobState.QUEUED
            subject = Subject.parse(row.subject)
            self.jobs[job_id] = Job(row.kind, subject, producers, first, row.repeatable, row.use_cache)
            self.outbox[job_id] += first is JobState.QUEUED

    @rule(target=processes, worker=st.sampled_from(sorted(HOSTS)), queue=st.sampled_from([None, *QUEUES]))
    def claim(self, worker: str, queue: str | None) -> Any:
        wanted = QUEUES if queue is None else [queue]
        with self.catalogue.reading() as session:
            line = session.execute(
                select(JobRow.id, JobRow.queue, JobRow.priority, JobRow.position).where(
                    JobRow.state == JobState.QUEUED, JobRow.queue.in_(wanted)
                )
            ).all()
        held_back = worker in self.draining | self.given_up
        may_run = [row for row in line if row.queue not in self.paused and not held_back]
        pid = len(self.by_pid) + 1
        with self.catalogue.writing() as session:
            held = lifecycle.claim(session, wanted, worker, pid, self.now)
        if held is None:
            assert not may_run
            return multiple()
        best = min((-row.priority, row.position) for row in may_run)
        assert best in [(-row.priority, row.position) for row in may_run if row.id == held.job_id]
        job = self.jobs[held.job_id]
        assert held.fence > job.fence
        job.state, job.fence, job.worker = JobState.RUNNING, held.fence, worker
        self.by_pid[pid] = process = Process(held, worker, pid=pid)
        with self.catalogue.writing() as session:
            # Whatever it needs is there, each of its inputs once.
            inputs = indexing.resolve_inputs(session, held.job_id, self.now)
        assert len({one.role for one in inputs}) == len(inputs) >= len(job.producers)
        return process

    @rule(process=processes)
    def succeed(self, process: Process) -> None:
        held, job, was_live = process.claim, self.jobs[process.claim.job_id], self.is_live(process)
        key = f"{held.kind} {held.subject}"
        outputs = self.outputs(held)
        with self.catalogue.writing() as session:
            earlier = reuse.earlier_success(session, key) if held.use_cache and held.repeatable else None
            reused = None if earlier is None else earlier.job_id
            done = lifecycle.succeed(session, held, self.now, "done", reuse_key=key, reused_from=reused)
            if done and earlier is None:
                for one in outputs:
                    indexing.index(session, one, self.now)
        assert done == was_live
        if done:
            self.go(held.job_id, JobState.SUCCEEDED)
            if earlier is None:
                self.files.update(one.sealed.path for one in outputs)
            else:
                assert self.jobs[earlier.job_id].state is JobState.SUCCEEDED
                assert (job.use_cache, job.repeatable) == (True, True)

    def outputs(self, held: Claim) -> list[Entry]:
        """Return what a job makes: a recording, files of all views; every other, one."""
        subjects = [held.subject]
        if kind_named(held.kind).makes == MEASUREMENT:
            subjects = [replace(held.subject, view=view) for view in campaign().views]
        given = (
            select(DependencyRow.role, DependencyRow.source, FileRow.path, FileRow.content_hash)
            .join(FileRow, FileRow.id == DependencyRow.file_id)
            .where(DependencyRow.job_id == held.job_id)
        )
        with self.catalogue.reading() as session:
            inputs = tuple(InputReference(*row) for row in session.execute(given))
        return [
            Entry(
                Sealed(f"{subject}/{held.kind}-{held.job_id}-{held.attempt}.h5", "0", 1, DATASET_MEDIA_TYPE),
                provenance(
                    kind=held.kind, subject=subject, job_id=held.job_id, attempt=held.attempt, inputs=inputs
                ),
                recorded_at=self.now if len(subjects) > 1 else None,
            )
            for subject in subjects
        ]

    @rule(process=processes, end=st.sampled_from([JobState.FAILED, JobState.QUEUED]))
    def fail(self, process: Process, end: JobState) -> None:
        """Fail for good, or for the moment."""
        held, was_live = process.claim, self.is_live(process)
        with self.catalogue.writing() as session:
            done = lifecycle.change(session, held.job_id, end, self.now, "no light", fence=held.fence)
        assert done == was_live
        if done:
            self.go(held.job_id, end)

    @rule(process=processes)
    def report(self, process: Process) -> None:
        """Reach a checkpoint, and stop where that was asked for."""
        held, job = process.claim, self.jobs[process.claim.job_id]
        try:
            with self.catalogue.writing() as session:
                lifecycle.report_progress(session, held, 0.5, "half")
        except LeaseLost:
            assert not self.is_live(process)
        except (Cancelled, OverLimit) as error:
            end = JobState.FAILED if isinstance(error, OverLimit) else JobState.CANCELLED
            assert self.is_live(process)
            assert job.stop is end
            with self.catalogue.writing() as session:
                assert lifecycle.change(session, held.job_id, end, self.now, "asked", fence=held.fence)
            self.go(held.job_id, end)
        else:
            assert self.is_live(process)
            assert job.stop is None

    @rule(process=consumes(processes))
    def die(self, process: Process) -> None:
        process.lives = False

    @rule(seconds=st.integers(-3600, 3600))
    def wait(self, seconds: int) -> None:
        """Let time pass, or set the clock."""
        self.now += timedelta(seconds=seconds)

    @rule(worker=st.sampled_from(sorted(HOSTS)))
    def beat(self, worker: str) -> None:
        with self.catalogue.writing() as session:
            recovery.beat(session, worker, self.now)
        self.given_up.discard(worker)

    @rule(by=st.sampled_from(sorted(HOSTS)), others=st.sets(st.sampled_from(sorted(HOSTS))))
    def recover(self, by: str, others: set[str]) -> None:
        """Recover jobs; processes of others that are silent may live on, not know, and speak up later."""
        silent = others - {by}
        gone = [
            process.claim.job_id
            for process in self.by_pid.values()
            if self.is_live(process)
            and (process.worker in silent or (process.worker == by and not process.lives))
        ]
        with self.catalogue.writing() as session:
            lost = recovery.recover(session, self.now, by, BUDGET, self.living, silent)
        self.given_up |= silent
        assert sorted(lost) == sorted(gone)
        for job_id in lost:
            job = self.jobs[job_id]
            job.crashes += 1
            if job.stop is not None:
                self.go(job_id, job.stop)
            elif not job.repeatable:
                self.go(job_id, JobState.NEEDS_OPERATOR)
            else:
                self.go(job_id, JobState.QUARANTINED if job.crashes >= BUDGET else JobState.QUEUED)

    @precondition(lambda self: self.jobs)
    @rule(data=st.data(), limit=st.booleans())
    def stop(self, data: st.DataObject, limit: bool) -> None:
        """Cancel a job, or find that it takes too much."""
        job_id = self.drawn(data, list(self.jobs))
        job, end = self.jobs[job_id], JobState.FAILED if limit else JobState.CANCELLED
        with self.catalogue.writing() as session:
            if limit:
                done = orders.ask_to_stop(session, job_id, end, self.now, "took too much")
            else:
                done = orders.cancel(session, job_id, self.now)
        if job.state is JobState.RUNNING:
            assert done
            job.stop = job.stop or end
            return
        assert done == (not limit and JobState.CANCELLED in TRANSITIONS[job.state])
        if done:
            self.go(job_id, JobState.CANCELLED)

    @precondition(lambda self: any(job.state in UNSUCCESSFUL for job in self.jobs.values()))
    @rule(data=st.data())
    def retry(self, data: st.DataObject) -> None:
        ended = [i for i, job in self.jobs.items() if job.state in UNSUCCESSFUL]
        job_id = self.drawn(data, ended)
        job = self.jobs[job_id]
        states = [self.jobs[p].state for p in job.producers]
        if job.state is JobState.SKIPPED or any(state in UNSUCCESSFUL for state in states):
            with self.catalogue.writing() as session, pytest.raises(Conflict):
                orders.retry(session, job_id, self.now)
            return
        with self.catalogue.writing() as session:
            count = orders.retry(session, job_id, self.now)
        job.crashes, job.stop = 0, None
        ready = all(state is JobState.SUCCEEDED for state in states)
        self.go(job_id, JobState.QUEUED if ready else JobState.WAITING)
        assert count == 1 + self.bring_back(job_id)

    @rule(queue=st.sampled_from(QUEUES))
    def pause_or_resume(self, queue: str) -> None:
        with self.catalogue.writing() as session:
            if queue in self.paused:
                assert queues.resume(session, queue)
            else:
                queues.pause(session, queue, "the hall is in use", self.now)
        self.paused ^= {queue}

    @rule(worker=st.sampled_from(sorted(HOSTS)))
    @precondition(lambda self: not self.draining)
    def drain(self, worker: str) -> None:
        with self.catalogue.writing() as session:
            recovery.drain(session, worker)
        self.draining.add(worker)

    @precondition(lambda self: self.jobs)
    @rule(data=st.data(), to=st.sampled_from(["front", "back", 0, 5]))
    def order(self, data: st.DataObject, to: Any) -> None:
        """Move jobs, or rank them."""
        some = {self.drawn(data, list(self.jobs)) for _ in range(data.draw(st.integers(1, 4)))}
        before = self.line()
        mine = [job for job in before if job in some]
        if isinstance(to, int):
            with self.catalogue.writing() as session:
                assert queues.set_priority(session, by_ids(sorted(some)), to) == len(mine)
            return
        with self.catalogue.writing() as session:
            if not mine:
                with pytest.raises(Conflict):
                    queues.move(session, by_ids(sorted(some)), to)
                return
            assert queues.move(session, by_ids(sorted(some)), to) == len(mine)
        rest = [job for job in before if job not in some]
        assert self.line() == (mine + rest if to == "front" else rest + mine)

    def line(self) -> list[str]:
        """Return the jobs that have yet to begin, in the order in which they would."""
        query = select(JobRow.id).where(JobRow.state.in_((JobState.WAITING, JobState.QUEUED)))
        with self.catalogue.reading() as session:
            return list(session.scalars(query.order_by(JobRow.priority.desc(), JobRow.position, JobRow.id)))

    @rule()
    def ring(self) -> None:
        """Send the messages that are due."""
        with self.catalogue.writing() as session:
            due = doorbell.unsent(session)
            doorbell.sent(session, due)
        assert Counter(job_id for _, job_id, _ in due) == self.outbox
        self.outbox.clear()


@pytest.fixture(params=["embedded", "grown"])
def machine(request: pytest.FixtureRequest, home: Any) -> Iterator[type[JobLives]]:
    """The machine on either deployment."""
    urls = {}
    if request.param == "grown":
        urls["SMS_DATABASE_URL"] = request.getfixturevalue("fresh_postgresql_url")
    opened = Deployment(request.param, home, urls).catalogue(create=True)
    if opened.dialect == "sqlite":
        event.listen(opened.engine, "connect", _without_waiting_for_the_disk)
    schema.upgrade(opened)
    try:
        yield type("JobLivesOnce", (JobLives,), {"catalogue": opened})
    finally:
        opened.close()


def _without_waiting_for_the_disk(connection: Any, _record: Any) -> None:
    connection.execute("PRAGMA synchronous = OFF")


QUIET = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]


def test_jobs_live_as_the_model_says(machine: type[JobLives]) -> None:
    examples = 10 if machine.catalogue.dialect == "sqlite" else 3
    run_state_machine_as_test(  # type: ignore[no-untyped-call]
        machine, settings=settings(max_examples=examples, stateful_step_count=50, suppress_health_check=QUIET)
    )


@pytest.mark.long
def test_jobs_live_as_the_model_says_for_long(machine: type[JobLives]) -> None:
    examples = 400 if machine.catalogue.dialect == "sqlite" else 100
    run_state_machine_as_test(  # type: ignore[no-untyped-call]
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=120,
            suppress_health_check=QUIET,
            derandomize=False,
            report_multiple_bugs=False,
            phases=[Phase.generate],
        ),
    )
