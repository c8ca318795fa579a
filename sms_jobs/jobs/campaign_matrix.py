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
    """Return what there is of a campaign, the oldest first, in three queries however large it is.

    A result is stale where another version of its kind would compute it now, or another calibration holds
    for what it was computed from.
    """
    files, jobs = _files(session, campaign.id), _jobs(session, campaign)
    used = _calibrations_used(session, campaign.id)
    valid = ValidCalibrations(session, campaign.id, now)
    cells = []
    for state, view, kind in dict.fromkeys([*files, *jobs]):
        place = (state, view, kind)
        file, job = files.get(place), jobs.get(place)
        if job is not None and job[1] is not JobState.SUCCEEDED and (file is None or _tells(job[1])):
            condition = job[1].value
        elif file is None or (kind != MEASUREMENT and kind not in all_kinds()):
            continue  # not made yet, or no result: the definition of the campaign
        elif kind == MEASUREMENT:
            condition = "measured"
        else:
            holding = valid.of(Subject(campaign.name, state, view))
            own = used.get(file.number, set())
            other = file.version not in (None, all_kinds()[kind].version)
            withdrawn = state is not None and bool(own) and (holding is None or holding.number not in own)
            condition = "stale" if other or withdrawn else "computed"
        cells.append(
            Cell(
                *place,
                condition,
                None if file is None else file.number,
                "" if file is None else file.media_type,
                None if job is None else job[0],
            )
        )
    return cells


def _tells(state: JobState) -> bool:
    """Say whether the state of the newest job matters where an older one has given a result."""
    return state in ACTIVE or state in (JobState.FAILED, JobState.QUARANTINED, JobState.NEEDS_OPERATOR)


def _files(session: Session, campaign_id: int) -> dict[_Place, _File]:
    """Return the newest file of each place."""
    rows = session.execute(
        select(
            LoadStateRow.label,
            FileRow.view,
            FileRow.source,
            FileRow.id,
            FileRow.media_type,
            ResultRow.kind_version,
        )
        .outerjoin(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .outerjoin(ResultRow, ResultRow.file_id == FileRow.id)
        .where(FileRow.campaign_id == campaign_id)
        .order_by(FileRow.id)
    )
    return {
        (label, view, source): _File(number, media_type, version)
        for label, view, source, number, media_type, version in rows
    }


def _jobs(session: Session, campaign: CampaignRow) -> dict[_Place, tuple[str, JobState]]:
    """Return the newest job of each place."""
    rows = session.execute(
        select(JobRow.subject, JobRow.kind, JobRow.id, JobRow.state)
        .where(JobRow.campaign_id == campaign.id)
        .order_by(JobRow.position)
    )
    found: dict[_Place, tuple[str, JobState]] = {}
    for subject, kind, job, state in rows:
        about = Subject.parse(subject)
        found[about.state, about.view, kind] = (job, state)
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
