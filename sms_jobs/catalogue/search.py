"""Finds sealed files by what they are about, and where they come from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

from sqlalchemy import ColumnElement, Select, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.calibrations import AcceptanceRow, CalibrationRow, CalibrationUseRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow
from sms_jobs.catalogue.tables.files import FileRow, ReadingRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import NotFound
from sms_jobs.records.shown.files import CalibrationView, FileView
from sms_jobs.records.shown.times import known_time
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED

_MOST_DIGITS = 18


def find_files(
    session: Session,
    *,
    source: str | None = None,
    campaign: str | None = None,
    state: str | None = None,
    view: str | None = None,
    limit: int = 50,
) -> list[FileView]:
    """Return measurements, results and calibrations, the newest first."""
    query = _views().order_by(FileRow.id.desc()).limit(limit)
    if source is not None:
        query = query.where(FileRow.source == source)
    if campaign is not None:
        query = query.where(FileRow.campaign_id == campaigns.campaign_id(session, campaign))
    if state is not None:
        query = query.where(LoadStateRow.label == state)
    if view is not None:
        query = query.where(FileRow.view == view)
    return [_view(*row) for row in session.execute(query)]


def _is_number(key: str) -> bool:
    """Say whether a text can be the number of a file; one of thousands of digits is none."""
    return key.isascii() and key.isdecimal() and len(key) <= _MOST_DIGITS


def file_view(session: Session, key: str) -> FileView:
    """Return the file of that number or archive path.

    Raises
    ------
    NotFound
        There is no such file.
    """
    match = FileRow.id == int(key) if _is_number(key) else FileRow.path == key
    row = session.execute(_views().where(match)).one_or_none()
    if row is None:
        raise NotFound(f"there is no file '{key}' in the catalogue; 'sms data find' shows numbers and paths")
    return _view(*row)


def statistics(session: Session, file_id: int) -> dict[str, float]:
    """Return the numbers that a file can be found by."""
    rows = session.execute(
        select(StatisticRow.name, StatisticRow.value)
        .where(StatisticRow.file_id == file_id)
        .order_by(StatisticRow.name)
    )
    return dict(rows.all())


def readings(session: Session, file_id: int) -> dict[str, float]:
    """Return what scalar channels read while a file, or what it shows, was recorded."""
    rows = session.execute(
        select(ReadingRow.name, ReadingRow.value)
        .where(ReadingRow.file_id == file_id)
        .order_by(ReadingRow.name)
    )
    return dict(rows.all())


def parameters(session: Session, file_ids: Sequence[int]) -> dict[int, dict[str, Any]]:
    """Return the parameters that each of some files was computed with, where its job is known."""
    found: dict[int, dict[str, Any]] = {}
    for some in parts(file_ids):
        query = select(FileRow.id, JobRow.parameters).join(JobRow, JobRow.id == FileRow.job_id)
        found |= dict(session.execute(query.where(FileRow.id.in_(some))).tuples().all())
    return found


def files_of_job(session: Session, job_id: str) -> list[FileView]:
    """Return the files that a job has made."""
    query = _views().where(FileRow.job_id == job_id).order_by(FileRow.id)
    return [_view(*row) for row in session.execute(query)]


def list_calibrations(
    session: Session, rig: str | None = None, limit: int | None = None
) -> list[CalibrationView]:
    """Return calibrations, the one that became valid last first, unknown times last; at most `limit`."""
    latest = (
        CalibrationRow.valid_from == UNTIMED,
        CalibrationRow.valid_from.desc(),
        CalibrationRow.id.desc(),
    )
    query = _calibrations().order_by(*latest).limit(limit)
    if rig is not None:
        query = query.where(RigRow.name == rig)
    return _calibration_views(session, query)


def calibration_view(session: Session, number: int) -> CalibrationView:
    """Return the calibration of that number; raise `NotFound` where there is none."""
    views = _calibration_views(session, _calibrations().where(CalibrationRow.id == number))
    if not views:
        raise NotFound(f"there is no calibration {number}; 'sms calibration list' shows them")
    return views[0]


def calibrations_used(session: Session, file: int) -> list[CalibrationView]:
    """Return the calibrations that a file was computed with, by itself or through its inputs."""
    used = select(CalibrationUseRow.calibration_id).where(CalibrationUseRow.file_id == file)
    return _calibration_views(
        session, _calibrations().where(CalibrationRow.id.in_(used)).order_by(CalibrationRow.id)
    )


def calibrations_of_files(session: Session, paths: Sequence[str]) -> list[CalibrationView]:
    """Return the calibrations that lie in some files."""
    views = []
    for some in parts(paths):
        query = _calibrations().where(FileRow.path.in_(some))
        views += _calibration_views(session, query.order_by(CalibrationRow.id))
    return views


def _calibrations() -> Select[CalibrationRow, str, FileRow]:
    return (
        select(CalibrationRow, RigRow.name, FileRow)
        .join(RigRow, RigRow.id == CalibrationRow.rig_id)
        .join(FileRow, FileRow.id == CalibrationRow.file_id)
    )


def _calibration_views(
    session: Session, query: Select[CalibrationRow, str, FileRow]
) -> list[CalibrationView]:
    rows = session.execute(query).all()
    used: dict[int, list[str]] = {}
    for some in parts(rows):
        accepted = (
            select(AcceptanceRow.calibration_id, AcceptanceRow.campaign)
            .where(
                AcceptanceRow.in_use,
                AcceptanceRow.calibration_id.in_([row.id for row, _, _ in some]),
            )
            .order_by(AcceptanceRow.campaign)
        )
        for number, campaign in session.execute(accepted):
            used.setdefault(number, []).append(campaign)
    return [
        CalibrationView(
            row.id,
            rig,
            known_time(row.valid_from),
            row.origin,
            tuple(row.sensors),
            file.path,
            file.content_hash,
            file.size_bytes,
            file.sha256,
            "" in used.get(row.id, ()),
            tuple(name for name in used.get(row.id, ()) if name),
        )
        for row, rig, file in rows
    ]


def views_with(
    session: Session, ids: Sequence[int], extra: Sequence[ColumnElement[Any]]
) -> Iterator[tuple[FileView, tuple[Any, ...]]]:
    """Yield the files of some numbers, each with further expressions about its row, in no certain order."""
    for some in parts(ids):
        query = _views().where(FileRow.id.in_(some)).add_columns(*extra)
        for row in session.execute(query):
            yield _view(*row[:3]), tuple(row[3:])


@cache
def _views() -> Select[FileRow, str, str]:
    return (
        select(FileRow, CampaignRow.name, LoadStateRow.label)
        .outerjoin(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .outerjoin(LoadStateRow, LoadStateRow.id == FileRow.state_id)
    )


def _view(row: FileRow, campaign: str | None, state: str | None) -> FileView:
    return FileView(
        id=row.id,
        source=row.source,
        subject="" if campaign is None else str(Subject(campaign, state, row.view)),
        path=row.path,
        content_hash=row.content_hash,
        size_bytes=row.size_bytes,
        sha256=row.sha256,
        media_type=row.media_type,
        created_at=row.created_at,
        recorded_at=known_time(row.recorded_at),
        job_id=row.job_id,
    )
