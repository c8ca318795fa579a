"""What people and limits ask of a job: to stop, and to be tried again."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import select, update
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import Conflict
from sms_jobs.jobs.running import lifecycle
from sms_jobs.records.job import UNSUCCESSFUL, JobState

SOMEBODY = "an operator"
"""Who asks, where no name is given."""


def cancel(session: Session, job_id: str, now: datetime, by: str = SOMEBODY) -> bool:
    """Cancel a job that does not run, or ask a running one to stop; False when it has ended already."""
    if ask_to_stop(session, job_id, JobState.CANCELLED, now, f"cancelled by {by}"):
        return True
    message = f"cancelled by {by} before it ran"
    return lifecycle.change(session, job_id, JobState.CANCELLED, now, message, finished_at=now)


def ask_to_stop(session: Session, job_id: str, end: JobState, now: datetime, reason: str) -> bool:
    """Ask a running job to stop and to end as `end`; False when it does not run.

    It hears of it at its next checkpoint. The first to ask is the one who is heard.
    """
    session.execute(
        update(JobRow)
        .where(JobRow.id == job_id, JobRow.state == JobState.RUNNING, JobRow.stop_as.is_(None))
        .values(stop_asked_at=now, stop_as=end, stop_reason=reason)
    )
    runs = select(JobRow.id).where(JobRow.id == job_id, JobRow.state == JobState.RUNNING)
    return session.scalar(runs) is not None


def retry(session: Session, job_id: str, now: datetime, by: str = SOMEBODY) -> int:
    """Give a job that ended without success another chance, and with it all that was skipped for it alone.

    What needs another job besides that did not succeed stays skipped until that one is retried too.

    Returns
    -------
    Number of jobs that wait or are queued again.

    Raises
    ------
    Conflict
        The job has not ended without success.
    """
    row = session.get_one(JobRow, job_id, with_for_update=True)
    if row.state not in UNSUCCESSFUL or row.state is JobState.SKIPPED:
        hint = " because of a job that it needs; retry that one" if row.state is JobState.SKIPPED else ""
        raise Conflict(f"job {job_id[:8]} is {row.state.value}{hint}; only a job that failed can be retried")
    producer = aliased(JobRow)
    producers = session.scalars(
        select(producer.state)
        .join(DependencyRow, DependencyRow.producer_id == producer.id)
        .where(DependencyRow.job_id == job_id)
    ).all()
    if any(state in UNSUCCESSFUL for state in producers):
        raise Conflict(f"job {job_id[:8]} needs a job that did not succeed; retry that one first")
    lifecycle.change(
        session,
        job_id,
        JobState.QUEUED if all(s is JobState.SUCCEEDED for s in producers) else JobState.WAITING,
        now,
        f"retried by {by}",
        finished_at=None,
        crashes=0,
        tries=0,
        stop_asked_at=None,
        stop_as=None,
        stop_reason=None,
    )
    return 1 + lifecycle.revive_dependents(session, [job_id], now)
