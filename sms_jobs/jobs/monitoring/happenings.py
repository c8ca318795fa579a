"""What has happened to jobs, in the order of the numbers of its rows, for those who follow it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import EventRow, JobRow
from sms_jobs.records.subject import Subject


@dataclass(frozen=True)
class Happening:
    """A change of a job's state.

    Attributes
    ----------
    number
        Of its row; rows are numbered before they are committed, and may become visible in another order.
    job, kind, subject, campaign
        Which job it is, and what about.
    state, attempt, message
        That it has come to, in which attempt, and why.
    at
        When.
    """

    number: int
    job: str
    kind: str
    subject: str
    campaign: str
    state: str
    attempt: int
    message: str
    at: datetime


def newest(session: Session) -> int:
    """Return the number of the newest change; 0 where there is none."""
    return session.scalar(select(func.max(EventRow.id))) or 0


def happened(
    session: Session, after: int, limit: int, missing: Sequence[tuple[int, int]] = ()
) -> list[Happening]:
    """Return changes in the order of their numbers: those after one, and those in some ranges before it."""
    ranges = (EventRow.id.between(first, last) for first, last in missing)
    rows = session.execute(
        select(EventRow, JobRow.kind, JobRow.subject)
        .join(JobRow, JobRow.id == EventRow.job_id)
        .where(or_(EventRow.id > after, *ranges))
        .order_by(EventRow.id)
        .limit(limit)
    )
    return [
        Happening(
            row.id,
            row.job_id,
            kind,
            subject,
            Subject.parse(subject).campaign,
            row.state.value,
            row.attempt,
            row.message,
            row.at,
        )
        for row, kind, subject in rows
    ]
