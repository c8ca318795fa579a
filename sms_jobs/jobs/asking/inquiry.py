"""What people ask about jobs: which there are, and how they stand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, job_counts
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow, SpecimenRow
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.errors import Conflict, NotFound
from sms_jobs.jobs.planning import chosen
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.records.job import SHORT_ID, UNSUCCESSFUL, JobState
from sms_jobs.records.subject import Subject


@dataclass(frozen=True)
class JobView:
    """One job as it is shown."""

    id: str
    kind: str
    subject: str
    state: str
    progress: float
    message: str
    error: str | None
    attempts: int
    priority: int
    submitted_at: datetime
    submitted_by: str
    started_at: datetime | None
    finished_at: datetime | None
    seconds: float | None
    reused_from: str | None
    parameters: dict[str, Any]

    @property
    def about(self) -> Subject:
        """What it is about."""
        return Subject.parse(self.subject)


def job_view(row: JobRow) -> JobView:
    """Return a job's row as it is shown."""
    begun, ended = row.started_at, row.finished_at
    return JobView(
        id=row.id,
        kind=row.kind,
        subject=row.subject,
        state=row.state.value,
        progress=row.progress,
        message=row.message,
        error=row.error,
        attempts=row.attempts,
        priority=row.priority,
        submitted_at=row.submitted_at,
        submitted_by=row.submitted_by,
        started_at=begun,
        finished_at=ended,
        seconds=(ended - begun).total_seconds() if begun and ended and ended >= begun else None,
        reused_from=row.reused_from,
        parameters=row.parameters,
    )


def find_job(session: Session, prefix: str) -> JobRow:
    """Return the job of that id, or else the one whose id begins so.

    Raises
    ------
    NotFound, Conflict
        There is none, or more than one.
    """
    # Pages and programs know whole ids, and an index leads to them.
    named = session.get(JobRow, prefix)
    if named is not None:
        return named
    matching = session.scalars(
        select(JobRow).where(JobRow.id.startswith(prefix, autoescape=True)).limit(2)
    ).all()
    if not prefix or not matching:
        raise NotFound(f"there is no job '{prefix}'; 'sms job list' shows them")
    if len(matching) > 1:
        raise Conflict(f"'{prefix}' is the beginning of several job ids; give more characters")
    return matching[0]


def find_jobs(session: Session, prefixes: Collection[str]) -> list[str]:
    """Return the ids of the jobs whose ids begin so; raises as `find_job` does."""
    return [find_job(session, prefix).id for prefix in prefixes]


def list_jobs(
    session: Session,
    *,
    campaign: str | None = None,
    states: Collection[JobState] = (),
    kind: str | None = None,
    limit: int = 50,
    after: str | None = None,
) -> list[JobView]:
    """Return jobs, the latest submitted first; those after the job whose id begins so, where it is given."""
    where: list[ColumnElement[bool]] = []
    if campaign is not None:
        where.append(JobRow.campaign_id == campaigns.campaign_id(session, campaign))
    if kind is not None:
        where.append(JobRow.kind == kind)
    if after is not None:
        where.append(JobRow.position < find_job(session, after).position)
    # An index has those of each state in order, and none those of several.
    each = [[*where, JobRow.state == state] for state in set(states)] or [where]
    rows = [
        row
        for some in each
        for row in session.scalars(select(JobRow).where(*some).order_by(JobRow.position.desc()).limit(limit))
    ]
    return [job_view(row) for row in sorted(rows, key=lambda row: -row.position)[:limit]]


def counts(session: Session, some: Chosen | None = None) -> dict[str, int]:
    """Return how many jobs are in each state; among some jobs, or all."""
    if some is None:
        return chosen.by_state(session, Chosen())
    # One that had ended before and was tried again since counts as active.
    return dict(Counter(chosen.by_state(session, some)) - Counter(some.ended_before))


@dataclass(frozen=True)
class Event:
    """A change of a job's state."""

    at: datetime
    state: str
    attempt: int
    message: str


def events(session: Session, job_id: str) -> list[Event]:
    """Return what has happened to a job, in order."""
    rows = session.scalars(select(EventRow).where(EventRow.job_id == job_id).order_by(EventRow.id))
    return [Event(row.at, row.state.value, row.attempt, row.message) for row in rows]


def campaign_names(session: Session) -> list[str]:
    """Return the names of all campaigns, the newest first."""
    return list(session.scalars(select(CampaignRow.name).order_by(CampaignRow.id.desc())))


@dataclass(frozen=True)
class CampaignView:
    """One campaign as it is listed."""

    campaign: str
    specimen: str
    rig: str
    states: int
    views: int
    created_at: datetime
    jobs: dict[str, int]


def list_campaigns(session: Session, limit: int) -> list[CampaignView]:
    """Return campaigns with how many jobs of each are in which state, the newest first."""
    rows = session.execute(
        select(
            CampaignRow.id,
            CampaignRow.name,
            SpecimenRow.name,
            RigRow.name,
            CampaignRow.views,
            CampaignRow.created_at,
        )
        .join(SpecimenRow, SpecimenRow.id == CampaignRow.specimen_id)
        .join(RigRow, RigRow.id == CampaignRow.rig_id)
        .order_by(CampaignRow.id.desc())
        .limit(limit)
    ).all()
    jobs: dict[int, dict[str, int]] = {row[0]: {} for row in rows}
    states: dict[int, int] = {}
    for some in parts(list(jobs)):
        by = (JobCountRow.campaign_id, JobCountRow.state)
        for (number, state), count in job_counts.counted(session, *by, campaigns=some).items():
            jobs[number][state.value] = count
        states |= campaigns.number_of_states(session, some)
    return [
        CampaignView(name, specimen, rig, states.get(number, 0), len(views), created, jobs[number])
        for number, name, specimen, rig, views, created in rows
    ]


def running(session: Session, some: Chosen) -> str:
    """Name the jobs that run among some jobs, and how far they have come."""
    rows = session.scalars(
        select(JobRow).where(*some.where, JobRow.state == JobState.RUNNING).order_by(JobRow.position).limit(4)
    )
    return ", ".join(f"{row.kind} {Subject.parse(row.subject).within}" for row in rows)


def reused(session: Session, some: Chosen) -> int:
    """Return how many of some jobs were reused."""
    query = select(func.count()).where(*some.where, JobRow.reused_from.is_not(None))
    return session.scalar(query) or 0


def failure(session: Session, some: Chosen) -> str:
    """Name the latest of some jobs that failed, and say why and what to do."""
    row = session.scalar(
        select(JobRow)
        .where(*some.where, JobRow.state.in_(UNSUCCESSFUL - {JobState.SKIPPED}))
        .order_by(func.coalesce(JobRow.finished_at, JobRow.started_at).desc())
        .limit(1)
    )
    if row is None:
        return "they were skipped; see 'sms job list'"
    said = f"the last was {row.kind} {row.subject}, {row.state.value}: {row.message}"
    # What waits for an operator is a recording.
    again = "sms acquire resume" if row.state is JobState.NEEDS_OPERATOR else "sms job retry"
    then = f"'{again} {row.id[:SHORT_ID]}'"
    return said if then in said else f"{said}; see 'sms job logs {row.id[:SHORT_ID]}', then {then}"
