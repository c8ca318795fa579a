"""Whether jobs that could run do run: workers, their processes, and queues; a finding says what to do.

What the catalogue alone can tell is found from any host; what only processes show, on their own host.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import combinations

import psutil
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import job_counts
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import QueueRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.running.origin import Origin, is_gone
from sms_jobs.jobs.running.witness import origin_of
from sms_jobs.records.job import ACTIVE, ALIVE_WITHIN, JobState
from sms_jobs.records.sizes import number_of

_MISSED_FOR = timedelta(days=1)
"""A worker that vanished is a finding for so long."""
_TAKES_WITHIN = timedelta(seconds=30)
"""A job that could run is taken by a worker that has a place for it in far less time."""
_STARTS_WITHIN = timedelta(seconds=45)
_STOPPED = frozenset({psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP})


@dataclass(frozen=True)
class _Workers:
    """Of the last day, and which of them live."""

    rows: Sequence[WorkerRow]
    alive: Sequence[WorkerRow]

    @classmethod
    def lately(cls, session: Session, now: datetime) -> _Workers:
        query = select(WorkerRow).where(WorkerRow.beat_at >= now - _MISSED_FOR).order_by(WorkerRow.started_at)
        rows = session.scalars(query).all()
        here = Origin.own()
        beating = (row for row in rows if now - row.beat_at <= ALIVE_WITHIN)
        return cls(rows, [row for row in beating if not is_gone(row.pid, origin_of(row), here)])

    @property
    def serving(self) -> list[WorkerRow]:
        """Those that may claim jobs."""
        return [row for row in self.alive if not row.draining]


def workers(session: Session, now: datetime) -> list[str]:
    """Find that nobody is there, who has vanished without another in its place, and who claims nothing."""
    recent = _Workers.lately(session, now)
    found = [*_nobody(session, recent)]
    for row in recent.rows:
        replaced = any(other.host == row.host and other.started_at > row.started_at for other in recent.alive)
        if row in recent.alive or row.draining or replaced:
            continue
        found.append(
            f"worker {row.id} on {row.host} gave its last sign of life at {row.beat_at:%Y-%m-%d %H:%M} UTC; "
            "look at that host, and start the service there again ('sms up', or 'systemctl start sms')"
        )
    found += [
        f"worker {row.id} on {row.host} claims no job: {row.held_for}; it goes on by itself"
        for row in recent.serving
        if row.held_for is not None
    ]
    return [*found, *_without_processes(recent, now), *_idle_beside_work(session, recent, now)]


def _nobody(session: Session, recent: _Workers) -> Iterator[str]:
    if recent.serving:
        return
    if recent.alive:
        yield "every worker that lives is draining and takes no more jobs; start another with 'sms up'"
        return
    counted = job_counts.counted(session, JobCountRow.state, states=ACTIVE)
    left, running = sum(counted.values()), counted.get((JobState.RUNNING,), 0)
    also = f", and {running} {'counts' if running == 1 else 'count'} as running" if running else ""
    wait = f"{number_of(left, 'job')} {'waits' if left == 1 else 'wait'}"
    yield (
        f"no worker is alive: {wait} for one{also}; start the service with 'sms up', or 'systemctl start sms'"
    )


def _without_processes(recent: _Workers, now: datetime) -> Iterator[str]:
    for row in recent.serving:
        if row.processes == 0 and now - row.started_at > ALIVE_WITHIN:
            none = f"none of its {row.concurrency} processes" if row.concurrency > 1 else "no process"
            yield (
                f"worker {row.id} on {row.host} has {none}: each ends as soon as it begins; "
                f"'logs/worker-{row.id}.log' in that host's home says why"
            )


def _idle_beside_work(session: Session, recent: _Workers, now: datetime) -> Iterator[str]:
    """Find workers that have places, and do not take what they could."""
    for row in recent.serving:
        if row.held_for is not None or row.processes == 0 or now - row.started_at < _STARTS_WITHIN:
            continue
        running, last = session.execute(
            select(func.count(), func.max(JobRow.started_at)).where(
                JobRow.worker_id == row.id, JobRow.state == JobState.RUNNING
            )
        ).one()
        if running >= row.concurrency or (last is not None and now - last < _TAKES_WITHIN):
            continue
        since = _queued_since(session, row.queues.split(","), now)
        if since is not None and now - since > _TAKES_WITHIN:
            yield (
                f"worker {row.id} on {row.host} runs {running} of {number_of(row.concurrency, 'job')} and "
                f"has not taken the next, which it could since {since:%Y-%m-%d %H:%M:%S} UTC; look whether "
                f"its processes are stopped and at 'logs/worker-{row.id}.log' there, then start the service "
                "there again"
            )


def _queued_since(session: Session, queues: Sequence[str], now: datetime) -> datetime | None:
    """Return since when the job that is claimed next from some queues could have been claimed."""
    paused = select(QueueRow.name).where(QueueRow.paused_at.is_not(None))
    first = (
        select(JobRow.id)
        .where(
            JobRow.state == JobState.QUEUED,
            JobRow.queue.in_(queues),
            JobRow.queue.not_in(paused),
            ~locks.waits_for_device(now),
        )
        .order_by(JobRow.priority.desc(), JobRow.position)
        .limit(1)
    )
    job_id = session.scalar(first)
    if job_id is None:
        return None
    query = select(func.max(EventRow.at)).where(EventRow.job_id == job_id, EventRow.state == JobState.QUEUED)
    return session.scalar(query)


def unserved(session: Session, now: datetime) -> list[str]:
    """Find queues with jobs in them that no living worker serves."""
    serving = _Workers.lately(session, now).serving
    served = {queue for row in serving for queue in row.queues.split(",")}
    found = []
    while serving:
        job = session.scalar(
            select(JobRow).where(JobRow.state == JobState.QUEUED, JobRow.queue.not_in(served)).limit(1)
        )
        if job is None:
            break
        served.add(job.queue)
        found.append(
            f"no worker that lives serves the queue '{job.queue}', in which {job.kind} {job.subject} waits; "
            f"run 'sms worker start --queues {job.queue}' on a host that can, or 'sms job cancel "
            f"{job.id[:8]}'"
        )
    return found


def processes(session: Session, now: datetime, here: Origin) -> list[str]:
    """Find processes of workers that are stopped, as far as numbers of processes mean the same here."""
    found: list[str] = []
    for row in _Workers.lately(session, now).alive:
        there = origin_of(row)
        if here.sees(there) and not is_gone(row.pid, there, here):
            found += _stopped(session, row, psutil.Process(row.pid))
    return found


def hosts(session: Session, now: datetime) -> list[str]:
    """Find machines or containers of one name: each does its own work, but nobody can tell which did what."""
    pairs = combinations(_Workers.lately(session, now).alive, 2)
    return [
        f"workers {one.id} and {other.id} both say that they are on '{one.host}' and are not on one machine: "
        "give each machine or container a name of its own ('hostnamectl set-hostname')"
        for one, other in pairs
        if one.host == other.host and _are_apart(origin_of(one), origin_of(other))
    ]


def _are_apart(one: Origin, other: Origin) -> bool:
    return bool(one.boot and other.boot) and not one.sees(other)


def _stopped(session: Session, row: WorkerRow, supervisor: psutil.Process) -> Iterator[str]:
    jobs = {
        pid: f"job {job_id[:8]} ({kind} {subject})"
        for pid, job_id, kind, subject in session.execute(
            select(JobRow.pid, JobRow.id, JobRow.kind, JobRow.subject).where(
                JobRow.worker_id == row.id, JobRow.state == JobState.RUNNING
            )
        )
    }
    for process in [supervisor, *_below(supervisor)]:
        try:
            status = process.status()
        except psutil.NoSuchProcess:
            continue
        if status not in _STOPPED:
            continue
        what = "the supervisor" if process == supervisor else "a process"
        runs = f"{jobs[process.pid]} runs in" if process.pid in jobs else f"{what} of worker {row.id},"
        yield (
            f"{runs} process {process.pid}, which is stopped; 'kill -CONT {process.pid}' lets it go on, "
            f"'kill -KILL {process.pid}' has its work restarted"
        )


def _below(process: psutil.Process) -> list[psutil.Process]:
    try:
        return list(process.children(recursive=True))
    except psutil.NoSuchProcess:
        return []
