"""Restores jobs that the catalogue has lost from the files that they made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Provenance
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.archiving.indexing import source_of
from sms_jobs.jobs.planning.graph import covering
from sms_jobs.jobs.results.reuse import reuse_key
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import MEASUREMENT, Kind
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.records.job import ACTIVE, JobState
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

_OF_UNKNOWN_KINDS = "cpu"


def objection(session: Session, provenance: Provenance, newest_attempt: int) -> str | None:
    """Say why a file is no output of its job; None when it is one.

    What was measured is kept whatever became of its job: it may not be measurable again.

    Parameters
    ----------
    newest_attempt
        That has left files of this job.
    """
    job = session.get(JobRow, provenance.job_id)
    if job is not None and job.state in ACTIVE:
        return f"its job {job.id[:8]} is {job.state.value}; wait until it has ended"
    if source_of(provenance) == MEASUREMENT:
        return None
    if job is not None and job.state is not JobState.SUCCEEDED:
        return f"its job {job.id[:8]} did not succeed, it is {job.state.value}"
    newest = newest_attempt if job is None else job.attempts
    if provenance.attempt != newest:
        return f"attempt {newest} of its job has taken the place of attempt {provenance.attempt}"
    return None


def restore(session: Session, campaign: Campaign, provenance: Provenance) -> None:
    """Add the job that made a file, unless the catalogue knows it: succeeded when its last file was made.

    Who asked for it, how long it took, and the jobs that were answered by its result do not stand in files.
    What a person brought in was made by none.
    """
    if not provenance.job_id:
        return
    row = session.get(JobRow, provenance.job_id)
    if row is not None:
        if row.finished_at is None or row.finished_at < provenance.created_at:
            row.finished_at = provenance.created_at
        return
    kind = all_kinds().get(provenance.kind)
    parameters = None if kind is None else _parameters(kind, provenance.parameters)
    subject = provenance.subject if kind is None else covering(kind, provenance.subject)
    session.add(
        JobRow(
            id=provenance.job_id,
            kind=provenance.kind,
            kind_version=provenance.kind_version,
            campaign_id=campaigns.campaign_id(session, campaign.name),
            subject=str(subject),
            parameters=dict(provenance.parameters),
            queue=_OF_UNKNOWN_KINDS if kind is None else kind.queue.value,
            position=int(provenance.created_at.timestamp() * 1e6),
            repeatable=kind is not None and parameters is not None and kind.repeatable(parameters),
            state=JobState.SUCCEEDED,
            submitted_at=provenance.created_at,
            finished_at=provenance.created_at,
            attempts=provenance.attempt,
            fence=provenance.attempt,
            progress=1.0,
            message="restored from its files",
        )
    )
    session.flush()
    session.add(
        EventRow(
            job_id=provenance.job_id,
            at=provenance.created_at,
            state=JobState.SUCCEEDED,
            attempt=provenance.attempt,
            message="restored from its files",
        )
    )
    _add_dependencies(session, campaign, kind, subject, provenance)


def _add_dependencies(
    session: Session, campaign: Campaign, kind: Kind[Any] | None, subject: Subject, provenance: Provenance
) -> None:
    # What an input was to be about, e.g. the state for which a calibration was valid, only the kind tells.
    needs: dict[str, Subject] = {}
    if kind is not None:
        parameters = _parameters(kind, provenance.parameters)
        if parameters is not None:
            needs = {n.role: n.subject for n in kind.checked_needs(campaign, subject, parameters)}
    for given in provenance.inputs:
        session.add(
            DependencyRow(
                job_id=provenance.job_id,
                role=given.role,
                source=given.source,
                subject=str(needs.get(given.role, subject)),
                file_id=session.scalar(select(FileRow.id).where(FileRow.path == given.path)),
            )
        )


def make_reusable(session: Session, campaign: Campaign, provenance: Provenance) -> None:
    """Give a job back its reuse key, once all that it makes is there and its version is the present one."""
    if not provenance.job_id:
        return
    row = session.get_one(JobRow, provenance.job_id)
    kind = all_kinds().get(provenance.kind)
    if kind is None or row.reuse_key is not None or row.kind_version != kind.version:
        return
    parameters, subject = _parameters(kind, provenance.parameters), Subject.parse(row.subject)
    if parameters is None or not _is_complete(session, campaign, subject, provenance):
        return
    try:
        context = kind.context(campaign, subject)
    except SmsError:
        return
    hashes = {given.role: given.content_hash for given in provenance.inputs}
    row.reuse_key = reuse_key(kind, subject, provenance.parameters, context, hashes)


def _is_complete(session: Session, campaign: Campaign, subject: Subject, provenance: Provenance) -> bool:
    """Say whether a job that covers several views, such as a recording, has a file of each."""
    if provenance.subject == subject:
        return True
    query = select(func.count(FileRow.view.distinct())).where(FileRow.job_id == provenance.job_id)
    return session.scalar(query) == len(campaign.recordings_at(subject.state or ""))


def _parameters(kind: Kind[Any], given: Mapping[str, Any]) -> Parameters | None:
    """Return the parameters of a job; None when the present version of its kind does not take them."""
    try:
        checked: Parameters = kind.parameters.model_validate(dict(given))
    except ValidationError:
        return None
    return checked
