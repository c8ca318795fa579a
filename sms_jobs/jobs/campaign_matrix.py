"""How far a campaign is: of each state, view and kind, what there is and whether it still holds."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import TypeAlias

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import (
    CalibrationUseRow,
    CampaignRow,
    FileRow,
    JobRow,
    LoadStateRow,
    ResultRow,
)
from sms_jobs.catalogue.valid_calibrations import ValidCalibrations
from sms_jobs.jobs.turned_results import turned_files
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.job import ACTIVE, JobState
from sms_jobs.records.shown.cells import Cell
from sms_jobs.records.subject import Subject

_Place: TypeAlias = tuple[str | None, str | None, str]
"""State, view and kind."""


@dataclass(frozen=True)
class _File:
    number: int
    media_type: str
    version: int | None


def matrix(session: Session, campaign: CampaignRow, now: datetime) -> list[Cell]:
    """Return what there is of a campaign, the oldest first, in a few queries however large it is.

    A result is stale where another version of its kind would compute it now, another calibration holds for
    what it was computed from, or it lies along the axes of another frame of the specimen. Where the newest
    job has reused a result, that is what there is.
    """
    files, by_job = _files(session, campaign.id)
    jobs = _jobs(session, campaign)
    turned = turned_files(session, campaign)
    used = _calibrations_used(session, campaign.id)
    valid = ValidCalibrations(session, campaign.id, now)
    cells = []
    for state, view, kind in dict.fromkeys([*files, *jobs]):
        place = (state, view, kind)
        job = jobs.get(place)
        file = by_job.get((place, "" if job is None else job.reused_from or ""), files.get(place))
        if job is not None and job.state is not JobState.SUCCEEDED and (file is None or _tells(job.state)):
            condition = job.state.value
        elif file is None or (kind != MEASUREMENT and kind not in all_kinds()):
            continue  # not made yet, or no result: the definition of the campaign
        elif kind == MEASUREMENT:
            condition = "measured"
        else:
            holding = valid.of(Subject(campaign.name, state, view))
            own = used.get(file.number, set())
            other = file.version not in (None, all_kinds()[kind].version)
            withdrawn = state is not None and bool(own) and (holding is None or holding.number not in own)
            other = other or file.number in turned
            condition = "stale" if other or withdrawn else "computed"
        cells.append(
            Cell(
                *place,
                condition,
                None if file is None else file.number,
                "" if file is None else file.media_type,
                None if job is None else job.id,
            )
        )
    return cells


def _tells(state: JobState) -> bool:
    """Say whether the state of the newest job matters where an older one has given a result."""
    return state in ACTIVE or state in (JobState.FAILED, JobState.QUARANTINED, JobState.NEEDS_OPERATOR)


@dataclass(frozen=True)
class _Job:
    id: str
    state: JobState
    reused_from: str | None


def _files(session: Session, campaign_id: int) -> tuple[dict[_Place, _File], dict[tuple[_Place, str], _File]]:
    """Return the newest file of each place, and that of each place and job."""
    rows = session.execute(
        select(
            LoadStateRow.label,
            FileRow.view,
            FileRow.source,
            FileRow.id,
            FileRow.media_type,
            ResultRow.kind_version,
            FileRow.job_id,
        )
        .outerjoin(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .outerjoin(ResultRow, ResultRow.file_id == FileRow.id)
        .where(FileRow.campaign_id == campaign_id)
        .order_by(FileRow.id)
    )
    newest: dict[_Place, _File] = {}
    by_job: dict[tuple[_Place, str], _File] = {}
    for label, view, source, number, media_type, version, job in rows:
        place = (label, view, source)
        newest[place] = by_job[place, job or ""] = _File(number, media_type, version)
    return newest, by_job


def _jobs(session: Session, campaign: CampaignRow) -> dict[_Place, _Job]:
    """Return the newest job of each place."""
    rows = session.execute(
        select(JobRow.subject, JobRow.kind, JobRow.id, JobRow.state, JobRow.reused_from)
        .where(JobRow.campaign_id == campaign.id)
        .order_by(JobRow.position)
    )
    found: dict[_Place, _Job] = {}
    for subject, kind, job, state, reused_from in rows:
        about = Subject.parse(subject)
        found[about.state, about.view, kind] = _Job(job, state, reused_from)
    return found


def _calibrations_used(session: Session, campaign_id: int) -> dict[int, set[int]]:
    rows = session.execute(
        select(CalibrationUseRow.file_id, CalibrationUseRow.calibration_id)
        .join(FileRow, FileRow.id == CalibrationUseRow.file_id)
        .where(FileRow.campaign_id == campaign_id)
    )
    used: dict[int, set[int]] = {}
    for file, calibration in rows:
        used.setdefault(file, set()).add(calibration)
    return used
