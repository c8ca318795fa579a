"""Queues that an operator holds back, and the order in which jobs leave them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, cast

from sqlalchemy import CursorResult, exists, func, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue import job_counts
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import QueueRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import Conflict
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.kinds.kind import Queue
from sms_jobs.records.job import JobState

QUEUES = tuple(queue.value for queue in Queue)
"""Those that every service has; beside them each rig has its own."""
HIGHEST_PRIORITY = 1_000_000

_FOR_ROOM = (QueueRow.paused_at.is_not(None), QueueRow.for_room)
_PENDING = (JobState.WAITING, JobState.QUEUED)


@dataclass(frozen=True)
class QueueView:
    """One queue as it is shown."""

    name: str
    queued: int
    running: int
    paused_at: datetime | None
    reason: str
    for_room: bool


def pause(session: Session, name: str, reason: str, now: datetime, *, for_room: bool = False) -> None:
    """Let no more jobs of a queue begin; those that run go on.

    With `for_room` it goes on by itself once there is room; a queue that is paused already stays as it is.
    """
    row = session.get(QueueRow, name, with_for_update=True)
    if row is None:
        session.add(QueueRow(name=name, paused_at=now, reason=reason, for_room=for_room))
    elif row.paused_at is None or (row.for_room and not for_room):
        row.paused_at, row.reason, row.for_room = now, reason, for_room


def are_held_for_room(session: Session) -> bool:
    """Tell whether a queue is paused because a disk was full."""
    return bool(session.scalar(select(exists().where(*_FOR_ROOM))))


def resume_for_room(session: Session) -> list[str]:
    """Let the queues go on that were paused because a disk was full; return their names."""
    names = list(session.scalars(select(QueueRow.name).where(*_FOR_ROOM)))
    for name in names:
        resume(session, name)
    return names


def resume(session: Session, name: str) -> bool:
    """Let the jobs of a queue begin again; False when it was not paused."""
    row = session.get(QueueRow, name)
    if row is None or row.paused_at is None:
        return False
    row.paused_at, row.reason, row.for_room = None, "", False
    return True


def queues(session: Session) -> list[QueueView]:
    """Return every queue and how it stands."""
    counted = job_counts.counted(
        session, JobCountRow.queue, JobCountRow.state, states=(JobState.QUEUED, JobState.RUNNING)
    )
    paused = {row.name: row for row in session.scalars(select(QueueRow))}
    return [
        QueueView(
            name,
            counted.get((name, JobState.QUEUED), 0),
            counted.get((name, JobState.RUNNING), 0),
            paused[name].paused_at if name in paused else None,
            paused[name].reason if name in paused else "",
            name in paused and paused[name].for_room,
        )
        for name in queue_names(session)
    ]


def queue_names(session: Session) -> list[str]:
    """Return the names of all queues: of every service, and of rigs that have jobs or workers."""
    with_jobs = job_counts.counted(session, JobCountRow.queue, states=(*_PENDING, JobState.RUNNING))
    served = session.scalars(select(WorkerRow.queues))
    others = {*(queue for (queue,) in with_jobs), *session.scalars(select(QueueRow.name))}
    for queues_of_worker in served:
        others.update(queues_of_worker.split(","))
    return [*QUEUES, *sorted(others - set(QUEUES))]


def set_priority(session: Session, some: Chosen, priority: int) -> int:
    """Give jobs that have not started a priority; higher runs earlier. Return how many there were."""
    pending = update(JobRow).where(*some.where, JobRow.state.in_(_PENDING))
    changed = session.execute(pending.values(priority=priority).execution_options(synchronize_session=False))
    return cast(CursorResult[Any], changed).rowcount


def move(session: Session, some: Chosen, to: Literal["front", "back"]) -> int:
    """Bring jobs that have not started before or behind all others, in the order they have among themselves.

    At the front they also get the highest priority that any such job has, at the back the lowest.

    Raises
    ------
    Conflict
        None of them has yet to begin.
    """
    pending = (*some.where, JobRow.state.in_(_PENDING))
    count = session.scalar(select(func.count()).where(*pending)) or 0
    if not count:
        raise Conflict("these jobs have already started or ended, so their place in the queue is gone")
    best = func.max if to == "front" else func.min
    edge = func.min if to == "front" else func.max
    priority, position = session.execute(
        select(best(JobRow.priority), edge(JobRow.position)).where(JobRow.state.in_(_PENDING))
    ).one()
    before_first = position - count - 1 if to == "front" else position
    order = (JobRow.priority.desc(), JobRow.position, JobRow.id)
    place = func.row_number().over(order_by=order).label("place")
    mine = select(JobRow.id, place).where(*pending).subquery()
    moved = session.execute(
        update(JobRow)
        .where(JobRow.id == mine.c.id, JobRow.state.in_(_PENDING))
        .values(priority=priority, position=before_first + mine.c.place)
        .execution_options(synchronize_session=False)
    )
    return cast(CursorResult[Any], moved).rowcount
