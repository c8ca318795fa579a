"""Finds jobs whose process vanished, and gives supervisors' signs of life; runs inside every supervisor."""

from __future__ import annotations

from collections.abc import Callable, Collection
from datetime import datetime, timedelta

from sqlalchemy import or_, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.parts import AT_ONCE
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.running import lifecycle
from sms_jobs.jobs.running.origin import Origin
from sms_jobs.records.job import JobState
from sms_jobs.records.subject import Subject

Living = Callable[[], Collection[int]]
"""Returns the processes in which a supervisor has jobs run, as they are at that moment."""

_UNKNOWN = Origin()
_LEASE = timedelta(seconds=30)


def register_worker(
    session: Session,
    worker_id: str,
    host: str,
    pid: int,
    queues: Collection[str],
    concurrency: int,
    now: datetime,
    *,
    origin: Origin = _UNKNOWN,
    lease: timedelta = _LEASE,
) -> None:
    """Add a supervisor to the catalogue; it may then claim jobs.

    Parameters
    ----------
    origin
        Where its process can be looked for.
    lease
        How long it may give no sign of life before its jobs are given up.
    """
    session.add(
        WorkerRow(
            id=worker_id,
            host=host,
            pid=pid,
            machine=origin.machine,
            boot=origin.boot,
            pid_namespace=origin.pid_namespace,
            process_started=origin.started,
            queues=",".join(queues),
            concurrency=concurrency,
            processes=concurrency,
            lease_s=lease.total_seconds(),
            started_at=now,
            beat_at=now,
        )
    )


def note_queues(session: Session, worker_id: str, queues: Collection[str]) -> None:
    """Note which queues a supervisor serves now."""
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(queues=",".join(queues)))


def drain(session: Session, worker_id: str) -> None:
    """Let a worker finish what it runs and claim nothing more."""
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(draining=True))


def hold(session: Session, worker_id: str, reason: str, at: Subject | None) -> None:
    """Let a worker claim nothing more until `release`, because from its host the archive cannot be used."""
    held = {"held_for": reason, "held_at": None if at is None else str(at)}
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(**held))


def release(session: Session, worker_id: str) -> None:
    """Let a worker that was held claim jobs again."""
    free = {"held_for": None, "held_at": None}
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(**free))


def beat(session: Session, worker_id: str, now: datetime, processes: int | None = None) -> None:
    """Give a supervisor's sign of life: what counts is that the number of its beats changes.

    Parameters
    ----------
    processes
        How many of its processes live; as before, if not given.
    """
    values: dict[str, object] = {"beat_at": now, "beats": WorkerRow.beats + 1, "given_up": False}
    if processes is not None:
        values["processes"] = processes
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(values))


def recover(
    session: Session,
    now: datetime,
    worker_id: str,
    crash_budget: int,
    living: Living,
    silent: Collection[str] = (),
) -> list[str]:
    """Declare lost what is lost and decide what becomes of it.

    A job is lost when it is the supervisor's own and its process is gone, or when it is that of a supervisor
    that is silent, which then claims nothing until it is heard again. It is queued again as long as it has
    crashed fewer than `crash_budget` times; one that must not be repeated waits for an operator instead.
    Devices that were held by what is gone are free again.

    Parameters
    ----------
    worker_id
        The supervisor that asks.
    silent
        Others, as its `Witness` has found them.

    Returns
    -------
    Ids of the jobs that were lost.
    """
    given_up = or_(JobRow.worker_id == worker_id, JobRow.worker_id.in_(silent))
    suspects = session.execute(
        select(JobRow, WorkerRow)
        .join(WorkerRow, WorkerRow.id == JobRow.worker_id)
        .where(JobRow.state == JobState.RUNNING, given_up)
        .with_for_update(skip_locked=True, of=JobRow)
    ).all()
    if silent:
        session.execute(update(WorkerRow).where(WorkerRow.id.in_(silent)).values(given_up=True))
    # Asked after the jobs were read: a process that has started meanwhile is among them.
    there = living() if suspects else ()
    lost = []
    for job, worker in suspects:
        if worker.id == worker_id and job.pid in there:
            continue
        why = (
            f"process {job.pid} on {worker.host} is gone"
            if worker.id == worker_id
            else f"worker {worker.id} on {worker.host}, which ran it, is gone or gives no sign of life; "
            f"last beat {worker.beat_at:%Y-%m-%d %H:%M:%S} UTC"
        )
        if lifecycle.change(
            session, job.id, JobState.LOST, now, why, fence=job.fence, crashes=job.crashes + 1
        ):
            lost.append(job.id)
    for job in session.scalars(select(JobRow).where(JobRow.state == JobState.LOST)).all():
        _decide(session, job, now, crash_budget)
    locks.release_dead(session, now)
    return lost


def queue_ready(catalogue: Catalogue, now: datetime) -> list[str]:
    """Queue waiting jobs whose producers have all succeeded, whatever kept them from being queued then.

    That is looked for seldom, and nobody waits meanwhile: it takes as long as many jobs wait.
    """
    with catalogue.reading() as session:
        found = session.scalars(lifecycle.ready().limit(AT_ONCE)).all()
    if not found:
        return []
    with catalogue.writing() as session:
        return lifecycle.change_some(
            session, found, JobState.QUEUED, now, lifecycle.READY, leaving=[JobState.WAITING]
        )


def _decide(session: Session, job: JobRow, now: datetime, crash_budget: int) -> None:
    if job.stop_as is not None:
        reason = f"{job.stop_reason}; its process was ended"
        error = reason if job.stop_as is JobState.FAILED else None
        lifecycle.change(session, job.id, job.stop_as, now, reason, finished_at=now, error=error)
    elif not job.repeatable:
        lifecycle.change(
            session,
            job.id,
            JobState.NEEDS_OPERATOR,
            now,
            "it was interrupted and is not repeated by itself: what it records cannot be asked for twice; "
            f"look at the rig, then 'sms acquire resume {job.id[:8]}'",
        )
    elif job.crashes >= crash_budget:
        lifecycle.change(
            session,
            job.id,
            JobState.QUARANTINED,
            now,
            f"its worker vanished {job.crashes} times; see 'sms job logs {job.id[:8]}', then "
            f"'sms job retry {job.id[:8]}'",
            finished_at=now,
        )
    else:
        lifecycle.change(session, job.id, JobState.QUEUED, now, f"queued again after crash {job.crashes}")
