"""Writes plans into the catalogue: planned from a reading session, entered in one short transaction.

Planning loads every kind and may take seconds, and SQLite lets one process write at a time: what is written
is made ready before, and whoever enters it only looks whether the jobs that it builds on are still coming.
"""

from __future__ import annotations

import hashlib
import random
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

from sqlalchemy import Table, insert, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue import campaigns, subject_files
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow, JobDeviceRow, OutboxRow
from sms_jobs.catalogue.valid_calibrations import ValidCalibrations
from sms_jobs.errors import PlanOutdated
from sms_jobs.jobs.archiving import calibration_choice
from sms_jobs.jobs.planning.graph import (
    Existing,
    PlannedInput,
    PlannedJob,
    Refused,
    Request,
    covering,
    plan_possible,
)
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, Kind, Need
from sms_jobs.records.job import ACTIVE, JobState

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

T = TypeVar("T")
TableRows: TypeAlias = tuple[type[Any], list[dict[str, Any]]]
"""A table and what is to be entered into it, by column."""

_TRIES = 20
"""So often a plan is made anew because what it builds on has changed before it was entered."""
_PAUSE_S = 0.05
_ID_BYTES = 8


@dataclass(frozen=True)
class Terms:
    """On what terms jobs are submitted.

    Attributes
    ----------
    priority
        Higher runs earlier; equal ones run in order of submission.
    use_cache
        False to compute again what has been computed before.
    by
        The person, account or schedule that asks for it.
    """

    priority: int = 0
    use_cache: bool = True
    by: str = ""


USUAL = Terms()


@dataclass(frozen=True)
class Submission:
    """The jobs of one submission, in an order in which each comes after those it needs."""

    job_ids: tuple[str, ...]
    kinds: tuple[str, ...]
    campaign_id: int
    submitted_at: datetime


@dataclass(frozen=True)
class Draft:
    """Jobs that are planned and not yet entered.

    Attributes
    ----------
    campaign_id, definition_hash
        Of the campaign as it was planned for.
    submitted_at
        When that was.
    job_ids, jobs
        The planned jobs and the ids that they will have.
    producers
        Jobs of earlier submissions that these wait for.
    rows
        What is to be entered, by table; each table after those that it refers to.
    refused
        States that could not be planned.
    """

    campaign_id: int
    definition_hash: str
    submitted_at: datetime
    job_ids: tuple[str, ...]
    jobs: tuple[PlannedJob, ...]
    producers: tuple[str, ...]
    rows: tuple[TableRows, ...]
    refused: tuple[Refused, ...] = ()

    def whole(self) -> Draft:
        """Return this draft if it has all that was asked for; raise why a state was refused otherwise."""
        if self.refused:
            raise self.refused[0].error
        return self

    @property
    def submission(self) -> Submission:
        """What it comes to once it is entered."""
        kinds = tuple(job.kind.name for job in self.jobs)
        return Submission(self.job_ids, kinds, self.campaign_id, self.submitted_at)

    def of(self, table: type[Any]) -> list[dict[str, Any]]:
        """Return what is to be entered into one table."""
        return dict(self.rows).get(table, [])


def submit(
    session: Session,
    campaign_name: str,
    requests: Sequence[Request],
    now: datetime,
    terms: Terms = USUAL,
) -> Submission:
    """Plan requests and enter their jobs in one writing session, as `submit_to` does in two."""
    planned = draft(session, campaign_name, requests, now, terms)
    return enter(session, planned.whole())


def submit_to(
    catalogue: Catalogue,
    campaign_name: str,
    requests: Sequence[Request],
    now: datetime,
    terms: Terms = USUAL,
) -> Submission:
    """Plan requests and enter all their jobs or none; where something changes in between, plan again.

    Parameters
    ----------
    campaign_name, requests
        See `planning.plan_possible`.
    now
        With time zone.

    Raises
    ------
    InvalidInput, NotFound
        See `planning.plan`.
    PlanOutdated
        What it builds on changes faster than it can be planned.
    """

    def drafted() -> Draft:
        with catalogue.reading() as session:
            return draft(session, campaign_name, requests, now, terms)

    def entered(planned: Draft) -> Submission:
        with catalogue.writing() as session:
            return enter(session, planned.whole())

    return while_outdated(lambda: entered(drafted()))


def while_outdated(attempt: Callable[[], T]) -> T:
    """Return what an attempt to plan and enter returns; try again where its plan had become outdated."""
    for _ in range(_TRIES - 1):
        try:
            return attempt()
        except PlanOutdated:
            time.sleep(random.uniform(0.0, _PAUSE_S))  # noqa: S311 - chance that keeps no secret
    return attempt()


def draft(
    session: Session,
    campaign_name: str,
    requests: Sequence[Request],
    now: datetime,
    terms: Terms = USUAL,
    *,
    key: str = "",
    amended: Campaign | None = None,
) -> Draft:
    """Plan requests for the states that allow it, and write nothing; raises as `plan_possible` does.

    Parameters
    ----------
    key
        Of what asks for these jobs once: the same key gives the same ids, which cannot be entered twice.
        Empty for ids that are drawn.
    amended
        What the campaign will be once the transaction that enters the jobs has amended it; what it is now if
        not given.
    """
    row = campaigns.campaign_row(session, campaign_name)
    campaign = amended or campaigns.definition(row)

    coming = _coming(session, row.id)
    valid = ValidCalibrations(session, row.id, now)

    @cache
    def turned() -> set[int]:
        # What makes keys reads archives, which nobody who submits other kinds should wait for.
        from sms_jobs.jobs.results.turned import turned_files

        return turned_files(session, row)

    def find(need: Need) -> Existing | None:
        if need.source == CALIBRATION:
            used = calibration_choice.holding(session, valid, campaign.rig, need.subject)
            file_id = None if used is None else used.file_id
        elif (job_id := coming(need)) is not None:
            return Existing(job_id=job_id)
        else:
            file_id = subject_files.newest_file(session, need.source, need.subject, DATASET_MEDIA_TYPE)
            if file_id is not None and _lies_along_frame(need.source) and file_id in turned():
                # One of the frame that holds goes before a newer one; where there is none, what is made of it
                # is stale, and told to be.
                all_of = subject_files.files_newest_first(
                    session, need.source, need.subject, DATASET_MEDIA_TYPE
                )
                file_id = next((one for one in all_of if one not in turned()), file_id)
        return None if file_id is None else Existing(file_id=file_id)

    found = plan_possible(campaign, requests, find)
    jobs = found.jobs
    ids = tuple(_job_id(key, job) for job in jobs)
    producers = {i.existing.job_id for job in jobs for i in job.inputs if i.existing is not None}
    return Draft(
        row.id,
        row.definition_hash if amended is None else campaigns.definition_hash(amended),
        now,
        ids,
        jobs,
        tuple(sorted(job_id for job_id in producers if job_id is not None)),
        tuple(_rows(row.id, campaign, jobs, ids, now, terms)),
        found.refused,
    )


def _lies_along_frame(source: str) -> bool:
    kind = all_kinds().get(source)
    return kind is not None and kind.along_frame


def _job_id(key: str, job: PlannedJob) -> str:
    """Return the id of a new job; that of a key and a job is always the same."""
    if not key:
        return secrets.token_hex(_ID_BYTES)
    asked = f"{key}/{job.kind.name}/{job.subject}"
    return hashlib.sha256(asked.encode()).hexdigest()[: 2 * _ID_BYTES]


def enter(session: Session, planned: Draft) -> Submission:
    """Enter planned jobs in a writing session; nothing is visible to anybody before it is committed.

    That a newer file or job has come meanwhile changes nothing: it is as if they had been submitted before.

    Raises
    ------
    PlanOutdated
        The campaign is another, a file is gone, or a job that these would wait for has ended or just ends.
    """
    if planned.jobs:
        _require_current(session, planned)
        try:
            connection = session.connection()
            for table, rows in planned.rows:
                connection.execute(insert(cast(Table, table.__table__)), rows)
        except IntegrityError as error:
            # A policy has let a file go that one of them needs.
            raise PlanOutdated("what these jobs need is gone meanwhile; submit them again") from error
    return planned.submission


def _require_current(session: Session, planned: Draft) -> None:
    known_by = select(CampaignRow.definition_hash).where(CampaignRow.id == planned.campaign_id)
    if session.scalar(known_by) != planned.definition_hash:
        raise PlanOutdated("the campaign was changed by someone else meanwhile; submit the jobs again")
    for some in parts(planned.producers):
        # Locked, so that none ends without seeing who waits for it; waiting here for one that is about to
        # could be in a circle.
        still = session.scalars(
            select(JobRow.id)
            .where(JobRow.id.in_(some), JobRow.state.in_(ACTIVE))
            .with_for_update(read=True, skip_locked=True)
        ).all()
        if len(still) < len(some):
            raise PlanOutdated("a job that these would wait for ends just now; submit them again")


def _coming(session: Session, campaign_id: int) -> Callable[[Need], str | None]:
    """Return a function that finds the newest job on its way to making what is needed."""
    rows = session.execute(
        select(JobRow.kind, JobRow.subject, JobRow.id)
        .where(JobRow.campaign_id == campaign_id, JobRow.state.in_(ACTIVE))
        .order_by(JobRow.position)
    )
    jobs = {(kind, subject): job_id for kind, subject, job_id in rows}
    makers: dict[str, list[Kind[Any]]] = {}
    for kind in all_kinds().values():
        makers.setdefault(kind.makes or kind.name, []).append(kind)

    def find(need: Need) -> str | None:
        # What a person brings in, such as a reference surface, no job makes.
        found = (jobs.get((m.name, str(covering(m, need.subject)))) for m in makers.get(need.source, ()))
        return next((job_id for job_id in found if job_id is not None), None)

    return find


def _rows(
    campaign_id: int,
    campaign: Campaign,
    jobs: Sequence[PlannedJob],
    ids: Sequence[str],
    now: datetime,
    terms: Terms,
) -> Iterator[TableRows]:
    """Yield what is to be entered, table by table, where there is anything."""
    queues = [job.kind.queue_for(campaign) for job in jobs]
    states = [
        JobState.WAITING if any(_producer(i, ids) for i in job.inputs) else JobState.QUEUED for job in jobs
    ]
    same = {
        "campaign_id": campaign_id,
        "use_cache": terms.use_cache,
        "submitted_at": now,
        "submitted_by": terms.by,
    }
    first = int(now.timestamp() * 1e6)
    submitted = [
        {
            **_job_columns(job),
            **same,
            "id": job_id,
            "queue": queue,
            "priority": terms.priority + job.priority,
            "position": first + place,
            "state": state,
        }
        for place, (job_id, job, queue, state) in enumerate(zip(ids, jobs, queues, states, strict=True))
    ]
    events = [
        {"job_id": i, "at": now, "state": s, "attempt": 0, "message": "submitted"}
        for i, s in zip(ids, states, strict=True)
    ]
    messages = [
        {"job_id": i, "queue": queue}
        for i, queue, s in zip(ids, queues, states, strict=True)
        if s is JobState.QUEUED
    ]
    devices = [
        {"job_id": job_id, "device": device}
        for job_id, job in zip(ids, jobs, strict=True)
        for device in set(job.kind.devices(campaign, job.subject))
    ]
    tables: list[TableRows] = [
        (JobRow, submitted),
        (DependencyRow, _dependencies(jobs, ids)),
        (EventRow, events),
        (OutboxRow, messages),
        (JobDeviceRow, devices),
    ]
    yield from ((table, rows) for table, rows in tables if rows)


def _job_columns(job: PlannedJob) -> dict[str, Any]:
    """Return what a planned job says itself of its row."""
    return {
        "kind": job.kind.name,
        "kind_version": job.kind.version,
        "subject": str(job.subject),
        "parameters": job.parameters.model_dump(mode="json"),
        "repeatable": job.kind.repeatable(job.parameters),
    }


def _dependencies(jobs: Sequence[PlannedJob], ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return a row for each input of each job."""
    return [
        {
            "job_id": job_id,
            "role": given.need.role,
            "source": given.need.source,
            "subject": str(given.need.subject),
            "producer_id": _producer(given, ids),
            "file_id": None if given.existing is None else given.existing.file_id,
        }
        for job_id, job in zip(ids, jobs, strict=True)
        for given in job.inputs
    ]


def _producer(given: PlannedInput, ids: Sequence[str]) -> str | None:
    if given.producer is not None:
        return ids[given.producer]
    return None if given.existing is None else given.existing.job_id
