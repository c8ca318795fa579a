"""What anybody could keep on paper about jobs: who needs whom, where each stands, whose claim is the newest.

A state machine whose steps bring the catalogue and this model on together; after every step the two are
compared, with the table of transitions and with the events.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import ClassVar

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant
from sqlalchemy import delete, select

from sms_jobs.catalogue import campaigns, job_counts
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.every import written_tables
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import OutboxRow
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.job import TRANSITIONS, UNSUCCESSFUL, JobState
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate
from support.jobs import NOW, add_calibration_file

HOSTS = {"w1": "here", "w2": "there"}
QUEUES = ["cpu", "io", "acquisition"]


def campaign() -> Campaign:
    """Return a campaign of two states and two views: all its jobs are fifteen or so."""
    whole = small_plate("plate")[1]
    return replace(whole, states=whole.states[:2], views=whole.views[:2])


@dataclass
class Job:
    """What the model knows of a job."""

    kind: str
    subject: Subject
    producers: frozenset[str]
    state: JobState
    repeatable: bool
    use_cache: bool
    fence: int = 0
    crashes: int = 0
    stop: JobState | None = None
    worker: str = ""


@dataclass
class Process:
    """A process that runs, or ran, a job."""

    claim: Claim
    worker: str
    lives: bool = True
    pid: int = field(default=0)


class JobModel(RuleBasedStateMachine):
    """The model, without the steps."""

    catalogue: ClassVar[Catalogue]

    def __init__(self) -> None:
        super().__init__()
        self.now = NOW
        self.jobs: dict[str, Job] = {}
        self.by_pid: dict[int, Process] = {}
        self.paused: set[str] = set()
        self.draining: set[str] = set()
        self.given_up: set[str] = set()
        self.outbox: Counter[str] = Counter()
        self.files: set[str] = set()
        self.told: dict[str, list[tuple[JobState, int]]] = {}
        self.last_event = 0

    @initialize()
    def begin(self) -> None:
        with self.catalogue.writing() as session:
            for table in reversed(written_tables()):
                session.execute(delete(table))
            campaigns.add_campaign(session, campaign(), NOW)
            add_calibration_file(session, "plate")
            for worker, host in HOSTS.items():
                recovery.register_worker(session, worker, host, 1, QUEUES, 2, NOW)

    def living(self) -> set[int]:
        return {pid for pid, process in self.by_pid.items() if process.lives}

    def is_live(self, process: Process) -> bool:
        job = self.jobs[process.claim.job_id]
        return job.state is JobState.RUNNING and job.fence == process.claim.fence

    def dependents(self, job_id: str) -> list[str]:
        return [other for other, job in self.jobs.items() if job_id in job.producers]

    def go(self, job_id: str, state: JobState) -> None:
        """Bring a job to a state, and those that depend on it to where they then belong."""
        self.jobs[job_id].state = state
        if state is JobState.QUEUED:
            self.outbox[job_id] += 1
        for other in self.dependents(job_id):
            job = self.jobs[other]
            if job.state is not JobState.WAITING:
                continue
            if state in UNSUCCESSFUL:
                self.go(other, JobState.SKIPPED)
            elif all(self.jobs[p].state is JobState.SUCCEEDED for p in job.producers):
                self.go(other, JobState.QUEUED)

    def drawn(self, data: st.DataObject, job_ids: list[str]) -> str:
        """Draw a job by its place: ids are new in every run, and a failure is to repeat itself."""
        return job_ids[data.draw(st.integers(0, len(job_ids) - 1), label="job")]

    def bring_back(self, job_id: str) -> int:
        """Let what was skipped wait again, unless something else that it needs has not succeeded."""
        count = 0
        for other in self.dependents(job_id):
            job = self.jobs[other]
            if job.state is JobState.SKIPPED and not any(
                self.jobs[p].state in UNSUCCESSFUL for p in job.producers
            ):
                job.state = JobState.WAITING
                count += 1 + self.bring_back(other)
        return count

    @invariant()
    def the_catalogue_says_what_the_model_says(self) -> None:
        with self.catalogue.reading() as session:
            rows = session.execute(
                select(JobRow.id, JobRow.state, JobRow.fence, JobRow.attempts, JobRow.crashes, JobRow.stop_as)
            ).all()
            files = session.scalars(select(FileRow.path).where(FileRow.job_id.is_not(None))).all()
            makers = set(session.scalars(select(FileRow.job_id).where(FileRow.job_id.is_not(None))))
            due = session.scalars(select(OutboxRow.job_id)).all()
        if not self.jobs:
            return
        assert {row.id: (row.state, row.fence, row.crashes) for row in rows} == {
            job_id: (job.state, job.fence, job.crashes) for job_id, job in self.jobs.items()
        }
        assert all(row.fence == row.attempts for row in rows)
        assert all(row.stop_as is self.jobs[row.id].stop for row in rows)
        # Outputs are registered once, and only those of jobs that have succeeded.
        assert sorted(files) == sorted(self.files)
        assert all(self.jobs[job_id].state is JobState.SUCCEEDED for job_id in makers)
        # No message is lost, whoever crashes: one for every time that a job was queued.
        assert Counter(due) == self.outbox

    @invariant()
    def the_jobs_are_counted(self) -> None:
        with self.catalogue.reading() as session:
            assert not job_counts.differ(session)
            counted = job_counts.counted(session, JobCountRow.state)
        assert counted == Counter((job.state,) for job in self.jobs.values())

    @invariant()
    def a_job_stands_where_what_it_needs_puts_it(self) -> None:
        for job in self.jobs.values():
            needed = [self.jobs[p].state for p in job.producers]
            if job.state is JobState.WAITING:
                assert not any(state in UNSUCCESSFUL for state in needed)
                assert not all(state is JobState.SUCCEEDED for state in needed)
            elif job.state is JobState.SKIPPED:
                assert any(state in UNSUCCESSFUL for state in needed)
            elif job.state is not JobState.CANCELLED:
                assert all(state is JobState.SUCCEEDED for state in needed)

    @invariant()
    def no_job_is_run_by_two(self) -> None:
        live = Counter(p.claim.job_id for p in self.by_pid.values() if self.is_live(p))
        running = {job_id for job_id, job in self.jobs.items() if job.state is JobState.RUNNING}
        assert live == Counter(running)

    @invariant()
    def events_tell_the_same_story(self) -> None:
        if not self.jobs:
            return
        with self.catalogue.reading() as session:
            new = session.execute(
                select(EventRow.id, EventRow.job_id, EventRow.state, EventRow.attempt)
                .where(EventRow.id > self.last_event)
                .order_by(EventRow.id)
            ).all()
        for number, job_id, state, attempt in new:
            self.last_event = number
            story = self.told.setdefault(job_id, [])
            if story:
                assert state in TRANSITIONS[story[-1][0]], (job_id, story, state)
            else:
                assert state in (JobState.WAITING, JobState.QUEUED)
            story.append((state, attempt))
        for job_id, job in self.jobs.items():
            assert self.told[job_id][-1][0] is job.state
            begun = [attempt for state, attempt in self.told[job_id] if state is JobState.RUNNING]
            assert begun == list(range(1, job.fence + 1))
