"""For which queues messages are to be sent. They only wake processes: losing all of them loses nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import job_counts
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import OutboxRow, QueueRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.records.job import ALIVE_WITHIN, JobState


@dataclass(frozen=True)
class Call:
    """Jobs of a queue for which processes are to be woken: how many, and one of them by its id."""

    queue: str
    job_id: str
    number: int


def unsent(session: Session, limit: int = 500) -> list[tuple[int, str, str]]:
    """Return (outbox id, job id, queue) of messages that are due, oldest first."""
    rows = session.execute(
        select(OutboxRow.id, OutboxRow.job_id, OutboxRow.queue).order_by(OutboxRow.id).limit(limit)
    )
    return [(key, job_id, queue) for key, job_id, queue in rows]


def calls(messages: Sequence[tuple[int, str, str]]) -> list[Call]:
    """Return what messages that are due come to, queue by queue."""
    number = Counter(queue for _, _, queue in messages)
    first = {queue: job_id for _, job_id, queue in reversed(messages)}
    return [Call(queue, job_id, number[queue]) for queue, job_id in first.items()]


def sent(session: Session, messages: Sequence[tuple[int, str, str]]) -> None:
    """Forget messages that the broker has taken."""
    # Rows of jobs are left alone: whoever is woken would find them locked, and pass them over.
    session.execute(delete(OutboxRow).where(OutboxRow.id.in_([key for key, _, _ in messages])))


def unheard(session: Session) -> list[Call]:
    """Return the jobs that are queued, whatever became of their messages; those of paused queues are not."""
    paused = set(session.scalars(select(QueueRow.name).where(QueueRow.paused_at.is_not(None))))
    queued = job_counts.counted(session, JobCountRow.queue, states=[JobState.QUEUED])
    found = []
    for (queue,), number in sorted(queued.items()):
        first = select(JobRow.id).where(JobRow.state == JobState.QUEUED, JobRow.queue == queue).limit(1)
        if queue not in paused and (job_id := session.scalar(first)) is not None:
            found.append(Call(queue, job_id, number))
    return found


def listeners(session: Session, now: datetime) -> Counter[str]:
    """Return how many processes of living workers serve each queue."""
    found: Counter[str] = Counter()
    alive = select(WorkerRow.queues, WorkerRow.concurrency).where(
        WorkerRow.beat_at >= now - ALIVE_WITHIN, WorkerRow.draining.is_(False)
    )
    for queues, concurrency in session.execute(alive):
        found.update(dict.fromkeys(queues.split(","), concurrency))
    return found
