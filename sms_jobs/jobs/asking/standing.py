"""How an installation stands at a glance: how many campaigns and jobs there are, and who works.

What it says takes few tables, and a command that says no more maps no others.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.records.job import ACTIVE, JobState


def number_of_campaigns(session: Session) -> int:
    """Return how many campaigns there are."""
    return session.scalar(select(func.count()).select_from(CampaignRow)) or 0


def still_active(counted: dict[str, int]) -> int:
    """Return how many of some counted jobs have not ended."""
    return sum(counted.get(state.value, 0) for state in ACTIVE)


@dataclass(frozen=True)
class WorkerView:
    """One supervisor as it is shown."""

    id: str
    host: str
    pid: int
    queues: str
    concurrency: int
    processes: int
    """How many of them lived at the last beat."""
    beat_at: datetime
    draining: bool
    held_for: str | None
    running: int


def workers(session: Session, since: datetime) -> list[WorkerView]:
    """Return the workers that have given a sign of life since a time.

    Those that were on this machine, and whose process is gone since, are left out.
    """
    rows = session.scalars(
        select(WorkerRow).where(WorkerRow.beat_at >= since).order_by(WorkerRow.started_at)
    ).all()
    if not rows:
        return []
    # Which nothing else here needs, and a home without workers neither.
    from sms_jobs.catalogue.tables.jobs import JobRow
    from sms_jobs.jobs.running.origin import Origin, is_gone
    from sms_jobs.jobs.running.witness import origin_of

    running = select(JobRow.worker_id, func.count()).where(JobRow.state == JobState.RUNNING)
    by_worker = dict(session.execute(running.group_by(JobRow.worker_id)).all())
    here = Origin.own()
    return [
        WorkerView(
            *(w.id, w.host, w.pid, w.queues, w.concurrency, w.processes, w.beat_at, w.draining),
            *(w.held_for, by_worker.get(w.id, 0)),
        )
        for w in rows
        if not is_gone(w.pid, origin_of(w), here)
    ]
