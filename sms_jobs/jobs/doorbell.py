"""Which messages are to be sent. A message only wakes a worker: losing all of them loses nothing."""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import delete, or_, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import JobRow, OutboxRow
from sms_jobs.records.job import JobState


def unsent(session: Session, limit: int = 500) -> list[tuple[int, str, str]]:
    """Return (outbox id, job id, queue) of messages that are due, oldest first."""
    rows = session.execute(
        select(OutboxRow.id, OutboxRow.job_id, OutboxRow.queue).order_by(OutboxRow.id).limit(limit)
    )
    return [(key, job_id, queue) for key, job_id, queue in rows]


def sent(session: Session, messages: list[tuple[int, str, str]], now: datetime) -> None:
    """Forget messages that the broker has taken."""
    session.execute(delete(OutboxRow).where(OutboxRow.id.in_([key for key, _, _ in messages])))
    session.execute(
        update(JobRow).where(JobRow.id.in_([job_id for _, job_id, _ in messages])).values(rung_at=now)
    )


def overdue(session: Session, now: datetime, patience: timedelta, limit: int) -> list[tuple[str, str]]:
    """Return (job id, queue) of jobs that are queued although their message was sent long ago.

    `limit` is how many a worker can run at once: more messages would wake nobody.
    """
    rows = session.execute(
        select(JobRow.id, JobRow.queue)
        .where(
            JobRow.state == JobState.QUEUED,
            or_(JobRow.rung_at.is_(None), JobRow.rung_at < now - patience),
        )
        .order_by(JobRow.priority.desc(), JobRow.position)
        .limit(limit)
    )
    return [(job_id, queue) for job_id, queue in rows]


def rung(session: Session, job_ids: list[str], now: datetime) -> None:
    """Note that messages about these jobs were sent again."""
    session.execute(update(JobRow).where(JobRow.id.in_(job_ids)).values(rung_at=now))
