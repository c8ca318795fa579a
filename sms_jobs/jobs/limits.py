"""What a running job may take, and when one that does not stop by itself is ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import Enum

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import JobRow
from sms_jobs.jobs import lifecycle
from sms_jobs.records.job import JobState

MemoryOf = Callable[[int], float | None]
"""Returns the resident memory of a process of this host in MB; None when it is gone."""


@dataclass(frozen=True)
class Limits:
    """Of every job; None for none.

    Attributes
    ----------
    time
        From its beginning.
    memory_mb
        Resident memory of its process.
    grace
        How long it may take to reach a checkpoint once it is asked to stop: after this it is told by a
        signal, after twice this it is killed.
    """

    time: timedelta | None
    memory_mb: float | None
    grace: timedelta


class Force(Enum):
    """How a process is ended."""

    TERMINATE = "terminate"
    KILL = "kill"


@dataclass(frozen=True)
class Overdue:
    """A job that was asked to stop and has not."""

    job_id: str
    pid: int
    began: datetime
    force: Force


def ask_those_over_limit(
    session: Session, worker_id: str, now: datetime, limits: Limits, memory_of: MemoryOf
) -> list[str]:
    """Ask the jobs of a worker that take too much to stop; they then fail. Return their ids."""
    asked = []
    for job in _running(session, worker_id):
        reason = _excess(job, now, limits, memory_of) if job.stop_asked_at is None else None
        if reason and lifecycle.ask_to_stop(session, job.id, JobState.FAILED, now, reason):
            asked.append(job.id)
    return asked


def overdue(session: Session, worker_id: str, now: datetime, limits: Limits) -> list[Overdue]:
    """Return the jobs of a worker that have not stopped in time, and by what force they are ended."""
    found = []
    for job in _running(session, worker_id):
        if job.stop_asked_at is None or job.pid is None or job.started_at is None:
            continue
        late = now - job.stop_asked_at
        if late >= limits.grace:
            force = Force.KILL if late >= 2 * limits.grace else Force.TERMINATE
            found.append(Overdue(job.id, job.pid, job.started_at, force))
    return found


def _running(session: Session, worker_id: str) -> list[JobRow]:
    query = select(JobRow).where(JobRow.worker_id == worker_id, JobRow.state == JobState.RUNNING)
    return list(session.scalars(query))


def _excess(job: JobRow, now: datetime, limits: Limits, memory_of: MemoryOf) -> str | None:
    if limits.time is not None and job.started_at is not None and now - job.started_at > limits.time:
        return (
            f"took longer than the {limits.time.total_seconds():g} s that a job may take; raise the setting "
            "job_time_limit_s, or split the work"
        )
    if limits.memory_mb is not None and job.pid is not None:
        used = memory_of(job.pid)
        if used is not None and used > limits.memory_mb:
            return (
                f"took {used:.0f} MB, more than the {limits.memory_mb:g} MB that a job may take; raise the "
                "setting job_memory_limit_mb, or give it less at once"
            )
    return None
