"""What was found when files of the archive were compared with what was sealed: entered, and summed up."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import case, delete, func, insert, or_, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.checks import FileCheckRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.jobs.keeping.verification import Checked
from sms_jobs.records.shown.archive_state import ArchiveState, CheckedFiles, DamagedFile

DUE_AFTER: Final = timedelta(days=90)
"""A disk is read four times a year; what no backup of a quarter has any more is lost."""
_MOST_DAMAGED = 1000


def enter(session: Session, checked: Sequence[Checked], now: datetime, *, quick: bool) -> None:
    """Enter what was found of some files.

    Parameters
    ----------
    quick
        Whether they were looked at for presence and size alone: what is wrong is entered then, and what
        seems right says nothing of the contents.
    """
    found = [one for one in checked if one.finding is not None or not quick]
    numbers = [one.file_id for one in found]
    # A policy may have removed one meanwhile.
    there = set(session.scalars(select(FileRow.id).where(FileRow.id.in_(numbers))))
    session.execute(delete(FileCheckRow).where(FileCheckRow.file_id.in_(there)))
    rows = [
        {
            "file_id": one.file_id,
            "checked_at": now,
            "problem": None if one.finding is None else one.finding.problem,
            "detail": "" if one.finding is None else one.finding.detail,
        }
        for one in found
        if one.file_id in there
    ]
    if rows:
        session.execute(insert(FileCheckRow), rows)


def state(session: Session, now: datetime) -> ArchiveState:
    """Return when files were compared, by campaign, which are due, and which are damaged."""
    due = or_(FileCheckRow.checked_at.is_(None), FileCheckRow.checked_at < now - DUE_AFTER)
    rows = session.execute(
        select(
            func.coalesce(CampaignRow.name, ""),
            func.count(FileRow.id),
            func.sum(FileRow.size_bytes),
            func.sum(case((due, 1), else_=0)),
            func.sum(case((due, FileRow.size_bytes), else_=0)),
            func.count(FileCheckRow.problem),
            func.min(FileCheckRow.checked_at),
            func.max(FileCheckRow.checked_at),
        )
        .select_from(FileRow)
        .outerjoin(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .outerjoin(FileCheckRow, FileCheckRow.file_id == FileRow.id)
        .group_by(CampaignRow.name)
        .order_by(CampaignRow.name)
    )
    campaigns = tuple(
        CheckedFiles(name, files, int(size), int(late), int(late_bytes), damaged, oldest, newest)
        for name, files, size, late, late_bytes, damaged, oldest, newest in rows
    )
    damaged_rows = session.execute(
        select(FileRow.id, FileRow.path, FileCheckRow.checked_at, FileCheckRow.problem, FileCheckRow.detail)
        .join(FileCheckRow, FileCheckRow.file_id == FileRow.id)
        .where(FileCheckRow.problem.is_not(None))
        .order_by(FileRow.id)
        .limit(_MOST_DAMAGED)
    )
    damaged_files = tuple(
        DamagedFile(number, path, at, problem or "", detail)
        for number, path, at, problem, detail in damaged_rows
    )
    return ArchiveState(DUE_AFTER / timedelta(days=1), campaigns, damaged_files)
