"""Finds jobs whose worker vanished, and workers' signs of life; runs inside every supervisor."""

from __future__ import annotations

from collections.abc import Callable, Collection
from datetime import datetime, timedelta

from sqlalchemy import or_, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import JobRow, WorkerRow
from sms_jobs.jobs import lifecycle, locks
from sms_jobs.records.job import JobState

ProcessLives = Callable[[int, datetime], bool]
"""Tells whether the process of that id, begun before that time, is alive on this host."""


def register_worker(
    session: Session,
    worker_id: str,
    host: str,
    pid: int,
    queues: Collection[str],
    concurrency: int,
    now: datetime,
) -> None:
    """Add a supervisor to the catalogue; it may then claim jobs."""
    session.add(
        WorkerRow(
            id=worker_id,
            host=host,
            pid=pid,
            queues=",".join(queues),
            concurrency=concurrency,
            started_at=now,
            beat_at=now,
            draining=False,
        )
    )


def note_queues(session: Session, worker_id: str, queues: Collection[str]) -> None:
    """Note which queues a supervisor serves now."""
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(queues=",".join(queues)))


def drain(session: Session, worker_id: str) -> None:
    """Let a worker finish what it runs and claim nothing more."""
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(draining=True))


def beat(session: Session, worker_id: str, now: datetime, lease: timedelta, lives: ProcessLives) -> None:
    """Extend the leases of a worker's jobs whose processes are alive; the others are left to expire."""
    session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(beat_at=now))
    held = session.execute(
        select(JobRow.id, JobRow.pid, JobRow.started_at).where(
            JobRow.worker_id == worker_id, JobRow.state == JobState.RUNNING
        )
    ).all()
    alive = [row.id for row in held if row.pid and row.started_at and lives(row.pid, row.started_at)]
    session.execute(
        update(JobRow)
        .where(JobRow.id.in_(alive), JobRow.worker_id == worker_id, JobRow.state == JobState.RUNNING)
        .values(lease_until=now + lease)
    )


def recover(session: Session, now: datetime, host: str, crash_budget: int, lives: ProcessLives) -> list[str]:
    """Declare lost what is lost and decide what becomes of it.

    A job is lost when its lease has run out, or at once when its process was on this host and is gone. It
    is queued again as long as it has crashed fewer than `crash_budget` times; one that must not be
    repeated waits for an operator instead. Devices that were held by what is gone are free again.

    Returns
    -------
    Ids of the jobs that were lost.
    """
    suspects = session.execute(
        select(JobRow, WorkerRow)
        .join(WorkerRow, WorkerRow.id == JobRow.worker_id)
        .where(
            JobRow.state == JobState.RUNNING,
            or_(JobRow.lease_until < now, WorkerRow.host == host),
        )
        .with_for_update(skip_locked=True, of=JobRow)
    ).all()
    lost = []
    for job, worker in suspects:
        expired = job.lease_until is None or job.lease_until < now
        gone = worker.host == host and not (job.pid and job.started_at and lives(job.pid, job.started_at))
        if not (expired or gone):
            continue
        why = (
            f"process {job.pid} on {worker.host} {'is gone' if gone else 'gives no sign of life'}; "
            f"last beat {worker.beat_at:%Y-%m-%d %H:%M:%S} UTC"
        )
        if lifecycle.change(
            session, job.id, JobState.LOST, now, why, fence=job.fence, crashes=job.crashes + 1
        ):
            lost.append(job.id)
    for job in session.scalars(select(JobRow).where(JobRow.state == JobState.LOST)).all():
        _decide(session, job, now, crash_budget)
    for job_id in session.scalars(lifecycle.ready()).all():
        lifecycle.change(
            session, job_id, JobState.QUEUED, now, "all it needs is there", leaving=[JobState.WAITING]
        )
    locks.release_dead(session, now)
    return lost


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
            f"look at the rig, then 'sms job retry {job.id[:8]}'",
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
