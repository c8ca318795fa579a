"""Writes a plan into the catalogue: jobs, their inputs and the messages about them, in one transaction."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import insert
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.models import DependencyRow, EventRow, JobRow, OutboxRow
from sms_jobs.jobs.planning import PlannedJob, Request, plan
from sms_jobs.kinds.kind import CALIBRATION, Need
from sms_jobs.records.job import JobState


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

    def archived(need: Need) -> int | None:
        if need.source == CALIBRATION:
            return campaigns.calibration_file(
                session, row.rig_id, campaigns.time_of(session, need.subject, now)
            )
        return campaigns.newest_file(session, need.source, need.subject)

    jobs = plan(campaign, requests, archived)
    ids = tuple(secrets.token_hex(8) for _ in jobs)
    if not jobs:
        return Submission((), ())
    _insert(session, row.id, jobs, ids, now, priority, use_cache)
    return Submission(ids, tuple(job.kind.name for job in jobs))


def _insert(
    session: Session,
    campaign_id: int,
    jobs: Sequence[PlannedJob],
    ids: Sequence[str],
    now: datetime,
    priority: int,
    use_cache: bool,
) -> None:
    first = int(now.timestamp() * 1e6)
    states = [
        JobState.WAITING if any(i.producer is not None for i in job.inputs) else JobState.QUEUED
        for job in jobs
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
                "queue": job.kind.queue.value,
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
            "producer_id": None if given.producer is None else ids[given.producer],
            "file_id": given.file_id,
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
        {"job_id": i, "queue": job.kind.queue.value}
        for i, job, s in zip(ids, jobs, states, strict=True)
        if s is JobState.QUEUED
    ]
    if ready:
        session.execute(insert(OutboxRow), ready)
