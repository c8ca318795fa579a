"""Which calibrations a file was computed with: read off the provenance once, when the file is entered."""

from __future__ import annotations

from sqlalchemy import delete, insert, literal, select, union
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue.models import BigId, CalibrationRow, CalibrationUseRow, ProvenanceRow

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


def note_all_calibrations(session: Session) -> None:
    """Enter anew for every file with which calibrations it was computed, from the whole provenance."""
    session.flush()
    session.execute(delete(CalibrationUseRow))
    used = (
        select(CalibrationRow.id.label("calibration_id"), ProvenanceRow.output_id.label("file_id"))
        .join(ProvenanceRow, ProvenanceRow.input_id == CalibrationRow.file_id)
        .cte("used", recursive=True)
    )
    used = used.union(
        select(used.c.calibration_id, ProvenanceRow.output_id).join(
            ProvenanceRow, ProvenanceRow.input_id == used.c.file_id
        )
    )
    session.execute(
        insert(CalibrationUseRow).from_select(_COLUMNS, select(used.c.calibration_id, used.c.file_id))
    )
