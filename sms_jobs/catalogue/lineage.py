"""What a file has from where it comes from: read off the provenance once, when the file is entered.

The calibrations that it was computed with, when it was recorded, and what scalar channels read meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime

from sqlalchemy import func, insert, literal, select, union
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue.tables.base import BigId
from sms_jobs.catalogue.tables.calibrations import CalibrationRow, CalibrationUseRow
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow, ReadingRow
from sms_jobs.records.recording import mean_readings

_COLUMNS = ["calibration_id", "file_id"]


def note_calibrations(session: Session, file_id: int) -> None:
    """Enter the calibrations among a file's inputs, and those that its inputs were computed with.

    To be called when the file's provenance is complete and that of its inputs is too.
    """
    session.flush()
    this = literal(file_id, BigId)
    direct = (
        select(CalibrationRow.id, this)
        .join(ProvenanceRow, ProvenanceRow.input_id == CalibrationRow.file_id)
        .where(ProvenanceRow.output_id == file_id)
    )
    earlier = aliased(CalibrationUseRow)
    through = (
        select(earlier.calibration_id, this)
        .join(ProvenanceRow, ProvenanceRow.input_id == earlier.file_id)
        .where(ProvenanceRow.output_id == file_id)
    )
    session.execute(insert(CalibrationUseRow).from_select(_COLUMNS, union(direct, through)))


def note_recording(session: Session, file: FileRow, at: datetime, readings: Mapping[str, float]) -> None:
    """Enter when a measurement was recorded, and what was read meanwhile."""
    file.recorded_at = at
    session.add_all(ReadingRow(file_id=file.id, name=name, value=value) for name, value in readings.items())


def note_recordings(session: Session, file: FileRow) -> None:
    """Enter when the inputs of a result were recorded, the last of them counts, and what was read meanwhile.

    Of a result about a state those recordings count that are of this state, and readings are their mean. What
    describes several states has no readings of its own. To be called when the file's provenance is complete
    and that of its inputs is too.
    """
    session.flush()
    given = ProvenanceRow.input_id == FileRow.id, ProvenanceRow.output_id == file.id
    if file.state_id is None:
        file.recorded_at = session.scalar(select(func.max(FileRow.recorded_at)).where(*given))
        return
    inputs = (
        select(FileRow.view, FileRow.recorded_at, ReadingRow.name, ReadingRow.value)
        .join(ProvenanceRow, ProvenanceRow.input_id == FileRow.id)
        .outerjoin(ReadingRow, ReadingRow.file_id == FileRow.id)
        .where(*given, FileRow.state_id == file.state_id, FileRow.recorded_at.is_not(None))
        .order_by(ProvenanceRow.role)
    )
    times: set[datetime | None] = set()
    of_views: dict[str | None, dict[str, float]] = {}
    # Several results of one view tell of one recording.
    for view, at, name, value in session.execute(inputs):
        times.add(at)
        if name is not None:
            of_views.setdefault(view, {})[name] = value
    file.recorded_at = max((at for at in times if at is not None), default=None)
    readings = mean_readings(list(of_views.values()))
    session.add_all(ReadingRow(file_id=file.id, name=name, value=value) for name, value in readings.items())
