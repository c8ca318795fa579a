"""What an operator does to all jobs of a campaign: part by part, so that nobody has to wait for the whole."""

from __future__ import annotations

import time
from collections.abc import Collection
from datetime import datetime
from typing import Any, cast

from sqlalchemy import ColumnElement, CursorResult, exists, func, select, update
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import Conflict
from sms_jobs.jobs.planning import chosen
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.running import lifecycle
from sms_jobs.jobs.running.orders import SOMEBODY
from sms_jobs.records.job import ACTIVE, UNSUCCESSFUL, JobState, origins
from sms_jobs.records.sizes import number_of

_PAUSE_S = 0.05
_PART = 200
"""Jobs in one transaction, which others wait for: some ten milliseconds."""
_RETRYABLE = UNSUCCESSFUL - {JobState.SKIPPED}


def cancel(catalogue: Catalogue, some: Chosen, now: datetime, by: str = SOMEBODY) -> int:
    """Cancel jobs that do not run, and ask running ones to stop; return how many there were.

    Those that were named by what they have in common are cancelled one and all. What needs a job that was
    cancelled is skipped.
    """
    # A person who names one that waits for an operator means it; one who means a campaign means what goes on.
    states = frozenset(origins(JobState.CANCELLED)) - {JobState.RUNNING}
    if some.ids is None:
        states &= ACTIVE
    stopping = (*some.where, JobRow.state == JobState.RUNNING, JobRow.stop_as.is_not(None))
    with catalogue.reading() as session:
        count = session.scalar(select(func.count()).where(*stopping)) or 0
    last = None
    while True:
        with catalogue.writing() as session:
            asked = _ask_to_stop(session, some, now, f"cancelled by {by}")
            part = _part(session, (*some.where, JobRow.state.in_(states)), last, newest_first=True)
            ids = [job_id for job_id, _ in part]
            message = f"cancelled by {by} before it ran"
            done = lifecycle.change_some(session, ids, JobState.CANCELLED, now, message, finished_at=now)
            lifecycle.skip_dependents(session, done, "a job that it needs is cancelled", now)
        count += asked + len(done)
        last = part[-1][1] if part else None
        if part or asked:
            continue
        with catalogue.reading() as session:
            if not session.scalar(select(exists().where(*some.where, JobRow.state.in_(states)))):
                return count
        time.sleep(_PAUSE_S)  # somebody else has it in hand


def _ask_to_stop(session: Session, some: Chosen, now: datetime, reason: str) -> int:
    asked = session.execute(
        update(JobRow)
        .where(*some.where, JobRow.state == JobState.RUNNING, JobRow.stop_as.is_(None))
        .values(stop_asked_at=now, stop_as=JobState.CANCELLED, stop_reason=reason)
        .execution_options(synchronize_session=False)
    )
    return cast(CursorResult[Any], asked).rowcount


def _part(
    session: Session,
    where: Collection[ColumnElement[bool]],
    last: int | None,
    *,
    newest_first: bool,
    locked: bool = True,
) -> list[tuple[str, int]]:
    """Return the ids and positions of the next jobs, behind the last one that was looked at.

    Nobody is waited for who has one of them in hand: he may be waiting for another.
    """
    query = select(JobRow.id, JobRow.position).where(*where).limit(_PART)
    if last is not None:
        query = query.where(JobRow.position <= last if newest_first else JobRow.position >= last)
    order = JobRow.position.desc() if newest_first else JobRow.position
    query = query.order_by(order)
    rows = session.execute(query.with_for_update(skip_locked=True, of=JobRow) if locked else query)
    return [(job_id, position) for job_id, position in rows]


def retry(catalogue: Catalogue, campaign: str, now: datetime, by: str = SOMEBODY) -> int:
    """Give the jobs of a campaign that ended without success another chance, with all skipped for them.

    Returns
    -------
    Number of jobs that wait or are queued again.

    Raises
    ------
    Conflict
        One needs a job of another campaign that did not succeed; the others are tried again.
    """
    with catalogue.reading() as session:
        some = chosen.of_campaign(session, campaign)
    count = 0
    # A job is tried again after those that it needs, in the next round if not in this one.
    while found := _retry_round(catalogue, some, now, f"retried by {by}"):
        count += found
    with catalogue.reading() as session:
        left = session.scalar(select(JobRow.id).where(*some.where, JobRow.state.in_(_RETRYABLE)).limit(1))
    if left is not None:
        raise Conflict(
            f"{number_of(count, 'job')} {'runs' if count == 1 else 'run'} again, but job {left[:8]} needs "
            "one that did not succeed; retry that one first"
        )
    return count


def _retry_round(catalogue: Catalogue, some: Chosen, now: datetime, message: str) -> int:
    producer = aliased(JobRow)
    needs = (DependencyRow.job_id == JobRow.id, producer.id == DependencyRow.producer_id)
    hopeless = exists().where(*needs, producer.state.in_(UNSUCCESSFUL))
    waits = exists().where(*needs, producer.state != JobState.SUCCEEDED)
    retryable = (JobRow.state.in_(_RETRYABLE), ~hopeless)
    count, last = 0, None
    while True:
        with catalogue.reading() as session:
            part = _part(session, (*some.where, *retryable), last, newest_first=False, locked=False)
        with catalogue.writing() as session:
            found = select(JobRow.id).where(JobRow.id.in_([job_id for job_id, _ in part]), *retryable)
            ids = session.scalars(found.with_for_update(skip_locked=True, of=JobRow)).all()
            waiting = set(session.scalars(select(JobRow.id).where(JobRow.id.in_(ids), waits)))
            afresh: dict[str, Any] = {
                "finished_at": None,
                "crashes": 0,
                "stop_asked_at": None,
                "stop_as": None,
                "stop_reason": None,
            }
            done: list[str] = []
            for target in (JobState.WAITING, JobState.QUEUED):
                those = [i for i in ids if (i in waiting) is (target is JobState.WAITING)]
                done += lifecycle.change_some(session, those, target, now, message, **afresh)
            count += len(done) + lifecycle.revive_dependents(session, done, now)
        if not done:
            return count
        last = part[-1][1]
