"""What has happened, in the order of the numbers of its rows, for those who follow it.

Changes of jobs and other changes are rows of two tables, each with numbers of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple, TypeAlias

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.changes import ChangeRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.records.shown.changes import Change
from sms_jobs.records.subject import Subject

Ranges: TypeAlias = Sequence[tuple[int, int]]
"""Numbers that are looked for: first and last of each range."""


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


class Cursor(NamedTuple):
    """Up to which numbers something is known: of changes of jobs, and of other changes."""

    jobs: int
    changes: int

    def __str__(self) -> str:
        return f"{self.jobs}-{self.changes}"

    @classmethod
    def parse(cls, text: str) -> Cursor:
        """Read it back; a number alone is of jobs, and other changes are then told from the first.

        Raises `ValueError` for a text that is none.
        """
        jobs, _, changes = text.partition("-")
        return cls(int(jobs), int(changes or 0))


class News(NamedTuple):
    """What has happened: changes of jobs, and other changes, each in the order of their numbers."""

    jobs: list[Happening]
    changes: list[Change]

    def placed(self, before: Cursor, safe: Cursor) -> list[tuple[Cursor, Happening | Change]]:
        """Return all in one order, each with where to go on after it so that nothing is missed.

        Parameters
        ----------
        before
            Up to which everything was told before these.
        safe
            Up to which nothing is missing, once all of these are told.
        """
        of_jobs = [(Cursor(min(safe.jobs, one.number), before.changes), one) for one in self.jobs]
        # Those of jobs are told by then.
        jobs = min(safe.jobs, max(before.jobs, self.jobs[-1].number)) if self.jobs else before.jobs
        return [*of_jobs, *((Cursor(jobs, min(safe.changes, one.number)), one) for one in self.changes)]


def newest(session: Session) -> Cursor:
    """Return the numbers of the newest changes; 0 where there are none."""
    return Cursor(
        session.scalar(select(func.max(EventRow.id))) or 0,
        session.scalar(select(func.max(ChangeRow.id))) or 0,
    )


def happened(session: Session, after: Cursor, limit: int, missing: tuple[Ranges, Ranges] = ((), ())) -> News:
    """Return what has happened after some numbers, and in some ranges before them: at most `limit` of each.

    Parameters
    ----------
    missing
        Ranges of changes of jobs, and of other changes.
    """
    return News(
        _of_jobs(session, after.jobs, limit, missing[0]), _changes(session, after.changes, limit, missing[1])
    )


def _of_jobs(session: Session, after: int, limit: int, missing: Ranges) -> list[Happening]:
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


def _changes(session: Session, after: int, limit: int, missing: Ranges) -> list[Change]:
    ranges = (ChangeRow.id.between(first, last) for first, last in missing)
    rows = session.scalars(
        select(ChangeRow).where(or_(ChangeRow.id > after, *ranges)).order_by(ChangeRow.id).limit(limit)
    )
    return [Change(row.id, row.topic, row.name, row.campaign, row.state, row.message, row.at) for row in rows]
