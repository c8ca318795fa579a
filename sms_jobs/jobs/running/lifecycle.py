"""Every change of a job's state: guarded by the state it leaves, and recorded as an event.

All functions take a writing session. A change that is not allowed, or that comes from an attempt which
has been superseded, changes nothing and returns False.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from typing import Any, cast

from sqlalchemy import ColumnElement, Row, Select, Table, bindparam, exists, insert, select, update
from sqlalchemy.orm import Session, aliased
from sqlalchemy.orm.util import identity_key
from sqlalchemy.sql.dml import ReturningUpdate

from sms_jobs.catalogue import changes
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.columns import UtcDateTime
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow, JobDeviceRow, OutboxRow, QueueRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import Cancelled, LeaseLost, OverLimit
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.notifying import occurrences
from sms_jobs.jobs.running import alike
from sms_jobs.records.job import UNSUCCESSFUL, JobState, origins
from sms_jobs.records.subject import Subject

# Statements that every job passes through are made once: that takes longer than running them.
_JOB = cast(Table, JobRow.__table__)
_EVENT = insert(cast(Table, EventRow.__table__)).inline()
_OUTBOX = insert(cast(Table, OutboxRow.__table__)).inline()
READY = "all it needs is there"
_UNCLAIM = (
    update(_JOB)
    .where(_JOB.c.id == bindparam("job"))
    .values(state=JobState.QUEUED, attempts=_JOB.c.attempts - 1)
)


@dataclass(frozen=True)
class Claim:
    """A worker's right to run a job, for as long as `fence` is the newest.

    Attributes
    ----------
    job_id, kind, subject, parameters, repeatable, use_cache
        As they were submitted.
    tries
        How often it was queued again since it was last given a chance, for what may pass by itself.
    fence, attempt
        Of this claim; others of the same job have others.
    campaign_id, definition_hash
        Of its campaign, at that moment.
    """

    job_id: str
    fence: int
    attempt: int
    campaign_id: int
    definition_hash: str
    kind: str
    subject: Subject
    parameters: dict[str, Any]
    repeatable: bool
    use_cache: bool
    tries: int


def change(
    session: Session,
    job_id: str,
    target: JobState,
    now: datetime,
    message: str,
    *,
    leaving: Collection[JobState] = (),
    fence: int | None = None,
    **columns: Any,
) -> bool:
    """Bring a job to `target` if it is in a state that allows it, and record the event.

    Parameters
    ----------
    leaving
        Narrows the states that may be left; by default all that the transition table allows.
    fence
        Of an attempt that ends: the change is made only if no newer one has started and the job still runs.
        One that was given up as lost may have been decided upon, without a newer attempt.
    columns
        Further columns to set.
    """
    statement = _changing(target, frozenset(leaving), fence is not None, tuple(sorted(columns)))
    values = {f"new_{name}": value for name, value in columns.items()}
    session.flush()
    changed = session.execute(
        statement, values | {"job": job_id, "said": message, "held": fence}
    ).one_or_none()
    if changed is None:
        return False
    if (loaded := session.identity_map.get(identity_key(JobRow, job_id))) is not None:
        session.expire(loaded)
    _tell(session, job_id, target, now, changed.attempts, message)
    occurrences.of_jobs(session, [job_id], target, now, message)
    changes.of_planned_jobs(session, [job_id], target, message)
    if target is JobState.QUEUED:
        session.execute(_OUTBOX, {"job_id": job_id, "queue": changed.queue})
    if target in UNSUCCESSFUL:
        skip_dependents(session, [job_id], f"job {job_id[:8]}, which it needs, is {target.value}", now)
    return True


def change_some(
    session: Session,
    job_ids: Sequence[str],
    target: JobState,
    now: datetime,
    message: str,
    *,
    leaving: Collection[JobState] = (),
    **columns: Any,
) -> list[str]:
    """Bring those of some jobs to `target` that are in a state that allows it, as `change` does; return them.

    What depends on them is left as it is.
    """
    allowed = [state for state in origins(target) if not leaving or state in leaving]
    session.flush()
    changed: list[Row[Any]] = []
    for some in parts(job_ids):
        statement = update(_JOB).where(_JOB.c.id.in_(some), _JOB.c.state.in_(allowed))
        values = {"state": target, "message": message, **columns}
        returned = statement.values(**values).returning(_JOB.c.id, _JOB.c.attempts, _JOB.c.queue)
        changed += session.execute(returned).all()
    if not changed:
        return []
    for row in changed:
        if (loaded := session.identity_map.get(identity_key(JobRow, row.id))) is not None:
            session.expire(loaded)
    event = {"at": now, "state": target, "message": message}
    session.execute(_EVENT, [{"job_id": row.id, "attempt": row.attempts, **event} for row in changed])
    occurrences.of_jobs(session, [row.id for row in changed], target, now, message)
    changes.of_planned_jobs(session, [row.id for row in changed], target, message)
    if target is JobState.QUEUED:
        session.execute(_OUTBOX, [{"job_id": row.id, "queue": row.queue} for row in changed])
    return [row.id for row in changed]


@cache
def _changing(
    target: JobState, leaving: frozenset[JobState], guarded: bool, columns: tuple[str, ...]
) -> ReturningUpdate[Any]:
    new = {name: bindparam(f"new_{name}", type_=_JOB.c[name].type) for name in columns}
    allowed = [state for state in origins(target) if not leaving or state in leaving]
    statement = update(_JOB).where(_JOB.c.id == bindparam("job"), _JOB.c.state.in_(allowed))
    if guarded:
        statement = statement.where(_JOB.c.fence == bindparam("held"), _JOB.c.state == JobState.RUNNING)
    values = {"state": target, "message": bindparam("said"), **new}
    return statement.values(**values).returning(_JOB.c.attempts, _JOB.c.queue)


def claim(session: Session, queues: Sequence[str], worker_id: str, pid: int, now: datetime) -> Claim | None:
    """Take the first queued job of some queues that are not paused, and with it the devices that it needs.

    None when there is none whose devices are free, or the worker is draining, held or given up.
    """
    attempt = {"queues": tuple(queues), "worker": worker_id, "process": pid, "now": now}
    session.flush()
    connection = session.connection()
    while (row := connection.execute(_claiming(), attempt).one_or_none()) is not None:
        if row.needs_devices and not locks.take_needed(session, row.id, row.fence, now):
            # Somebody was faster: as if it had never been claimed, and the next look leaves it out.
            session.execute(_UNCLAIM, {"job": row.id})
            continue
        message = f"claimed by worker {worker_id}, process {pid}"
        _tell(session, row.id, JobState.RUNNING, now, row.attempts, message)
        return Claim(
            row.id,
            row.fence,
            row.attempts,
            row.campaign_id,
            row.definition_hash,
            row.kind,
            Subject.parse(row.subject),
            row.parameters,
            row.repeatable,
            row.use_cache,
            row.tries,
        )
    return None


@cache
def _claiming() -> ReturningUpdate[Any]:
    now: ColumnElement[datetime] = bindparam("now", type_=UtcDateTime())
    candidate = (
        select(JobRow.id)
        .where(
            JobRow.state == JobState.QUEUED,
            JobRow.queue.in_(bindparam("queues", expanding=True)),
            exists().where(
                WorkerRow.id == bindparam("worker"),
                WorkerRow.draining.is_(False),
                WorkerRow.given_up.is_(False),
                WorkerRow.held_for.is_(None),
            ),
            ~exists().where(QueueRow.name == JobRow.queue, QueueRow.paused_at.is_not(None)),
            ~locks.waits_for_device(now),
            ~alike.is_computed(),
        )
        .order_by(JobRow.priority.desc(), JobRow.position)
        .limit(1)
        .with_for_update(skip_locked=True, of=JobRow)
    )
    return (
        update(_JOB)
        .where(_JOB.c.id == candidate.scalar_subquery(), _JOB.c.state == JobState.QUEUED)
        .values(
            state=JobState.RUNNING,
            fence=_JOB.c.fence + 1,
            attempts=_JOB.c.attempts + 1,
            worker_id=bindparam("worker"),
            pid=bindparam("process"),
            started_at=now,
            progress=0.0,
            message="",
            error=None,
        )
        .returning(
            _JOB.c.id,
            _JOB.c.fence,
            _JOB.c.attempts,
            _JOB.c.campaign_id,
            select(CampaignRow.definition_hash)
            .where(CampaignRow.id == _JOB.c.campaign_id)
            .scalar_subquery()
            .label("definition_hash"),
            _JOB.c.kind,
            _JOB.c.subject,
            _JOB.c.parameters,
            _JOB.c.repeatable,
            _JOB.c.use_cache,
            _JOB.c.tries,
            exists().where(JobDeviceRow.job_id == _JOB.c.id).label("needs_devices"),
        )
    )


def report_progress(session: Session, held: Claim, fraction: float, message: str) -> None:
    """Store how far a job has come.

    Raises
    ------
    LeaseLost
        A newer attempt has started.
    Cancelled, OverLimit
        The job is to stop, by an operator's word or because it went over a limit.
    """
    asked = session.execute(
        update(JobRow)
        .where(JobRow.id == held.job_id, JobRow.fence == held.fence, JobRow.state == JobState.RUNNING)
        .values(progress=fraction, message=message)
        .returning(JobRow.stop_as, JobRow.stop_reason)
    ).one_or_none()
    if asked is None:
        raise LeaseLost("a newer attempt has started")
    if asked.stop_as is not None:
        raise (OverLimit if asked.stop_as is JobState.FAILED else Cancelled)(asked.stop_reason or "")


def succeed(
    session: Session,
    held: Claim,
    now: datetime,
    message: str,
    *,
    reuse_key: str,
    reused_from: str | None = None,
) -> bool:
    """End a job well and queue the jobs that waited for it alone; False when the claim is lost."""
    done = change(
        session,
        held.job_id,
        JobState.SUCCEEDED,
        now,
        message,
        fence=held.fence,
        finished_at=now,
        progress=1.0,
        reuse_key=reuse_key,
        reused_from=reused_from,
    )
    if done:
        queue_ready_dependents(session, held.job_id, now)
    return done


def has_succeeded(session: Session, held: Claim) -> bool:
    """Tell whether an attempt has ended its job well: it may not have heard so."""
    ended = select(JobRow.id).where(
        JobRow.id == held.job_id, JobRow.fence == held.fence, JobRow.state == JobState.SUCCEEDED
    )
    return session.scalar(ended) is not None


def give_back(session: Session, worker_id: str, pid: int, held: Claim | None, now: datetime) -> list[str]:
    """Queue again what a process has claimed without hearing of it; return the ids of these jobs.

    Parameters
    ----------
    held
        What it knows that it holds.
    """
    unheard = select(JobRow.id, JobRow.fence).where(
        JobRow.worker_id == worker_id, JobRow.state == JobState.RUNNING, JobRow.pid == pid
    )
    found = [row for row in session.execute(unheard) if held is None or row.id != held.job_id]
    message = "it had not started: the database went away while it was claimed"
    for job_id, fence in found:
        change(session, job_id, JobState.QUEUED, now, message, fence=fence)
    return [job_id for job_id, _ in found]


def queue_ready_dependents(session: Session, producer_id: str, now: datetime) -> None:
    """Queue every waiting job that needs `producer_id` and whose producers have all succeeded."""
    # Locking the dependents first makes two producers that end at the same moment see each other.
    waiting = session.scalars(_waiting_for(), {"producer": producer_id}).all()
    if not waiting:
        return
    ready = [i for some in parts(waiting) for i in session.scalars(_ready(some=True), {"jobs": some})]
    change_some(session, ready, JobState.QUEUED, now, READY, leaving=[JobState.WAITING])


def ready() -> Select[str]:
    """Select waiting jobs whose producers have all succeeded."""
    return _ready(some=False)


@cache
def _waiting_for() -> Select[str]:
    needing = select(DependencyRow.job_id).where(DependencyRow.producer_id == bindparam("producer"))
    return (
        select(_JOB.c.id)
        .where(_JOB.c.id.in_(needing), _JOB.c.state == JobState.WAITING)
        .order_by(_JOB.c.id)
        .with_for_update()
    )


@cache
def _ready(*, some: bool) -> Select[str]:
    producer = aliased(JobRow)
    unfinished = exists().where(
        DependencyRow.job_id == JobRow.id,
        producer.id == DependencyRow.producer_id,
        producer.state != JobState.SUCCEEDED,
    )
    query = select(JobRow.id).where(JobRow.state == JobState.WAITING, ~unfinished).order_by(JobRow.position)
    return query.where(JobRow.id.in_(bindparam("jobs", expanding=True))) if some else query


def revive_dependents(session: Session, job_ids: Sequence[str], now: datetime) -> int:
    """Let jobs wait again that were skipped for some jobs and need no other that did not succeed.

    Returns
    -------
    Their number.
    """
    producer = aliased(JobRow)
    hopeless = exists().where(
        DependencyRow.job_id == JobRow.id,
        producer.id == DependencyRow.producer_id,
        producer.state.in_(UNSUCCESSFUL),
    )
    count = 0
    level = list(job_ids)
    while level:
        skipped = _dependents(session, level, JobState.SKIPPED, ~hopeless)
        message = "what it needs is tried again"
        level = change_some(session, skipped, JobState.WAITING, now, message, finished_at=None)
        count += len(level)
    return count


def skip_dependents(session: Session, job_ids: Sequence[str], why: str, now: datetime) -> None:
    """Skip the waiting jobs that need some jobs which did not succeed, and those that need these."""
    level = list(job_ids)
    while level:
        waiting = _dependents(session, level, JobState.WAITING)
        level = change_some(session, waiting, JobState.SKIPPED, now, why, finished_at=now)


def _dependents(
    session: Session, producers: Sequence[str], state: JobState, *further: ColumnElement[bool]
) -> list[str]:
    found: dict[str, None] = {}
    for some in parts(producers):
        needing = select(DependencyRow.job_id).where(DependencyRow.producer_id.in_(some))
        of_these = select(JobRow.id).where(JobRow.id.in_(needing), JobRow.state == state, *further)
        found |= dict.fromkeys(session.scalars(of_these.order_by(JobRow.id)))
    return sorted(found)


def _tell(session: Session, job_id: str, state: JobState, now: datetime, attempt: int, message: str) -> None:
    session.execute(
        _EVENT, {"job_id": job_id, "at": now, "state": state, "attempt": attempt, "message": message}
    )
