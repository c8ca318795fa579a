"""What a running job may take, and when one that does not stop by itself is ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import Enum

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.running import orders
from sms_jobs.jobs.running.stillness import Stillness
from sms_jobs.records.job import JobState

_LONGEST_STEP_S = 5.0
"""A supervisor looks every second, more rarely where it is held up; what it did not see does not count."""

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
        How long it may take to reach a checkpoint once it is asked to stop: after this it is sent
        a signal, after twice this it is killed.
    """

    time: timedelta | None
    memory_mb: float | None
    grace: timedelta


class Force(Enum):
    """How a process is ended."""

    TERMINATE = "terminate"
    KILL = "kill"


@dataclass(frozen=True)
class Observed:
    """A running job, as its supervisor has watched it by its own clock.

    Attributes
    ----------
    job_id, pid
        Of the job and its process.
    ran_s
        For how long it has been seen to run.
    asked_s
        For how long it has been asked to stop; None when it is not.
    """

    job_id: str
    pid: int
    ran_s: float
    asked_s: float | None


@dataclass(frozen=True)
class Overdue:
    """A job that was asked to stop and has not."""

    job_id: str
    pid: int
    force: Force


class Watch:
    """A supervisor's memory of when its jobs began and were asked to stop.

    The times in the catalogue are other clocks', which may have been set since.
    """

    def __init__(self) -> None:
        self._ran: Stillness[str] = Stillness(_LONGEST_STEP_S)
        self._asked: Stillness[str] = Stillness(_LONGEST_STEP_S)

    def look(self, session: Session, worker_id: str, now: float) -> list[Observed]:
        """Return the jobs that a worker runs.

        Parameters
        ----------
        now
            Seconds of a monotonic clock.
        """
        found = session.execute(
            select(JobRow.id, JobRow.fence, JobRow.pid, JobRow.stop_as).where(
                JobRow.worker_id == worker_id, JobRow.state == JobState.RUNNING
            )
        ).all()
        ran_s = self._ran.look({row.id: row.fence for row in found}, now)
        asked_s = self._asked.look({row.id: row.fence for row in found if row.stop_as is not None}, now)
        return [Observed(row.id, row.pid, ran_s[row.id], asked_s.get(row.id)) for row in found]


def ask_those_over_limit(
    session: Session, running: Sequence[Observed], now: datetime, limits: Limits, memory_of: MemoryOf
) -> list[str]:
    """Ask the jobs that take too much to stop; they then fail. Return their ids."""
    asked = []
    for job in running:
        reason = _excess(job, limits, memory_of) if job.asked_s is None else None
        if reason and orders.ask_to_stop(session, job.job_id, JobState.FAILED, now, reason):
            asked.append(job.job_id)
    return asked


def overdue(running: Sequence[Observed], limits: Limits) -> list[Overdue]:
    """Return the jobs that have not stopped in time, and by what force they are ended."""
    grace_s = limits.grace.total_seconds()
    return [
        Overdue(job.job_id, job.pid, Force.KILL if job.asked_s >= 2 * grace_s else Force.TERMINATE)
        for job in running
        if job.asked_s is not None and job.asked_s >= grace_s
    ]


def _excess(job: Observed, limits: Limits, memory_of: MemoryOf) -> str | None:
    if limits.time is not None and job.ran_s > limits.time.total_seconds():
        return (
            f"took longer than the {limits.time.total_seconds():g} s that a job may take; raise the setting "
            "job_time_limit_s, or split the work"
        )
    if limits.memory_mb is not None:
        used = memory_of(job.pid)
        if used is not None and used > limits.memory_mb:
            return (
                f"took {used:.0f} MB, more than the {limits.memory_mb:g} MB that a job may take; raise the "
                "setting job_memory_limit_mb, or give it less at once"
            )
    return None
