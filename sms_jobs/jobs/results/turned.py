"""Results that lie along other axes than the specimen's frame of their campaign has now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Row, Select, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, family
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.jobs.archiving.indexing import CAMPAIGN
from sms_jobs.jobs.results.reuse import reuse_key
from sms_jobs.kinds import all_kinds
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.subject import Subject


def turned_files(session: Session, campaign: CampaignRow) -> set[int]:
    """Return the files of a campaign that another frame was taken for, and those computed from them.

    A result is one of them where its reuse key is not what the present definition makes of its parameters and
    inputs. A campaign whose definition was never amended has none, and is not looked at.
    """
    if not _was_amended(session, campaign.id):
        return set()
    chosen = _along_the_frame().where(JobRow.campaign_id == campaign.id)
    known = campaigns.definition(campaign)
    jobs = [job for job in session.execute(chosen) if _is_current(job)]
    of_jobs = select(DependencyRow.job_id, DependencyRow.role, FileRow.content_hash)
    of_jobs = of_jobs.join(FileRow, FileRow.id == DependencyRow.file_id)
    hashes: dict[str, dict[str, str]] = {}
    for some in parts([job.id for job in jobs]):
        for job_id, role, content_hash in session.execute(of_jobs.where(DependencyRow.job_id.in_(some))):
            hashes.setdefault(job_id, {})[role] = content_hash
    other = [job.id for job in jobs if _key(known, job, hashes.get(job.id, {})) != job.reuse_key]
    files = {
        number
        for some in parts(other)
        for number in session.scalars(select(FileRow.id).where(FileRow.job_id.in_(some)))
    }
    return files | family.kin(session, files, down=True)


def is_turned(session: Session, job: JobRow) -> bool:
    """Say whether a job took another frame than its campaign has."""
    row = session.execute(_along_the_frame().where(JobRow.id == job.id)).one_or_none()
    if row is None or not _is_current(row):
        return False
    known = campaigns.definition(session.get_one(CampaignRow, job.campaign_id))
    return bool(_key(known, row, family.input_hashes(session, job.id)) != row.reuse_key)


def is_turned_file(session: Session, number: int) -> bool:
    """Say of one file what `turned_files` says of all of a campaign, in time that does not grow with it."""
    campaign = session.get_one(FileRow, number).campaign_id
    if campaign is None or not _was_amended(session, campaign):
        return False
    makers = select(JobRow).join(FileRow, FileRow.job_id == JobRow.id)
    along = JobRow.id.in_(_along_the_frame().with_only_columns(JobRow.id))
    return any(
        is_turned(session, job)
        for some in parts(sorted(family.kin(session, {number}, down=False) | {number}))
        for job in session.scalars(makers.where(FileRow.id.in_(some), along))
    )


def _was_amended(session: Session, campaign: int) -> bool:
    defined = select(func.count()).where(FileRow.campaign_id == campaign, FileRow.source == CAMPAIGN)
    return (session.scalar(defined) or 0) > 1


def _along_the_frame() -> Select[Any]:
    """Select the jobs of kinds whose numbers lie along the specimen's axes, of which it can be told."""
    kinds = [kind.name for kind in all_kinds().values() if kind.along_frame]
    return select(
        JobRow.id, JobRow.kind, JobRow.kind_version, JobRow.subject, JobRow.parameters, JobRow.reuse_key
    ).where(JobRow.kind.in_(kinds), JobRow.reuse_key.is_not(None))


def _is_current(job: Row[Any]) -> bool:
    return bool(all_kinds()[job.kind].version == job.kind_version)


def _key(campaign: Campaign, job: Row[Any], hashes: Mapping[str, str]) -> str:
    kind, subject = all_kinds()[job.kind], Subject.parse(job.subject)
    return reuse_key(kind, subject, job.parameters, kind.context(campaign, subject), hashes)
