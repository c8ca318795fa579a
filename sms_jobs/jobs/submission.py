"""Writes a plan into the catalogue: jobs, their inputs and the messages about them, in one transaction."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import insert, select
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.models import DependencyRow, EventRow, JobDeviceRow, JobRow, OutboxRow
from sms_jobs.jobs.planning import Existing, PlannedInput, PlannedJob, Request, covering, plan
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, Kind, Need
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.job import ACTIVE, JobState


@dataclass(frozen=True)
class Submission:
    """The jobs of one submission, in an order in which each comes after those it needs."""

    job_ids: tuple[str, ...]
    kinds: tuple[str, ...]


def submit(
    session: Session,
    campaign_name: str,
    requests: Sequence[Request],
    now: datetime,
    *,
    priority: int = 0,
    use_cache: bool = True,
) -> Submission:
    """Plan requests and add their jobs.

    Parameters
    ----------
    session
        A writing session; nothing is visible to anybody before it is committed.
    campaign_name, requests
        See `planning.plan`.
    now
        With time zone.
    priority
        Higher runs earlier; equal ones run in order of submission.
    use_cache
        False to compute again what has been computed before.

    Raises
    ------
    InvalidInput, NotFound
        See `planning.plan`.
    """
    row = campaigns.campaign_row(session, campaign_name)
    campaign = campaigns.definition(row)

    coming = _coming(session, row.id)

    def find(need: Need) -> Existing | None:
        if need.source == CALIBRATION:
            at = campaigns.time_of(session, need.subject, now)
            file_id = campaigns.calibration_file(session, row.rig_id, at)
        elif (job_id := coming(need)) is not None:
            return Existing(job_id=job_id)
        else:
            file_id = campaigns.newest_file(session, need.source, need.subject, DATASET_MEDIA_TYPE)
        return None if file_id is None else Existing(file_id=file_id)

    jobs = plan(campaign, requests, find)
    ids = tuple(secrets.token_hex(8) for _ in jobs)
    if not jobs:
        return Submission((), ())
    _insert(session, row.id, campaign, jobs, ids, now, priority, use_cache)
    _note_devices(session, campaign, jobs, ids)
    return Submission(ids, tuple(job.kind.name for job in jobs))


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


def _insert(
    session: Session,
    campaign_id: int,
    campaign: Campaign,
    jobs: Sequence[PlannedJob],
    ids: Sequence[str],
    now: datetime,
    priority: int,
    use_cache: bool,
) -> None:
    first = int(now.timestamp() * 1e6)
    states = [
        JobState.WAITING if any(_producer(i, ids) for i in job.inputs) else JobState.QUEUED for job in jobs
    ]
    session.execute(
        insert(JobRow),
        [
            {
                "id": job_id,
                "kind": job.kind.name,
                "kind_version": job.kind.version,
                "campaign_id": campaign_id,
                "subject": str(job.subject),
                "parameters": job.parameters.model_dump(mode="json"),
                "queue": job.kind.queue_for(campaign),
                "priority": priority,
                "position": first + place,
                "repeatable": job.kind.repeatable(job.parameters),
                "use_cache": use_cache,
                "state": state,
                "submitted_at": now,
            }
            for place, (job_id, job, state) in enumerate(zip(ids, jobs, states, strict=True))
        ],
    )
    edges = [
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
    if edges:
        session.execute(insert(DependencyRow), edges)
    session.execute(
        insert(EventRow),
        [
            {"job_id": i, "at": now, "state": s, "attempt": 0, "message": "submitted"}
            for i, s in zip(ids, states, strict=True)
        ],
    )
    ready = [
        {"job_id": i, "queue": job.kind.queue_for(campaign)}
        for i, job, s in zip(ids, jobs, states, strict=True)
        if s is JobState.QUEUED
    ]
    if ready:
        session.execute(insert(OutboxRow), ready)


def _note_devices(
    session: Session, campaign: Campaign, jobs: Sequence[PlannedJob], ids: Sequence[str]
) -> None:
    """Enter which devices the jobs have to hold while they run."""
    rows = [
        {"job_id": job_id, "device": device}
        for job_id, job in zip(ids, jobs, strict=True)
        for device in set(job.kind.devices(campaign, job.subject))
    ]
    if rows:
        session.execute(insert(JobDeviceRow), rows)


def _producer(given: PlannedInput, ids: Sequence[str]) -> str | None:
    if given.producer is not None:
        return ids[given.producer]
    return None if given.existing is None else given.existing.job_id
