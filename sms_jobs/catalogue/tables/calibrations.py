"""The tables of calibrations: which there are, which are used, and what was computed with them."""

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, Index
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.campaigns import RigRow
from sms_jobs.catalogue.tables.columns import String, Text
from sms_jobs.catalogue.tables.files import FileRow


class CalibrationRow(Table):
    """A calibration of a rig, valid from a time on."""

    __tablename__ = "calibration"
    __table_args__ = (Index(None, "rig_id", "valid_from"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey(RigRow.id))
    file_id: Mapped[int] = mapped_column(ForeignKey(FileRow.id), unique=True)
    valid_from: Mapped[datetime]
    origin: Mapped[str] = mapped_column(Text)
    sensors: Mapped[dict[str, Any]]
    """Role, columns and rows of each of its sensors, by name, in their order."""


class AcceptanceRow(Table):
    """The last decision whether a calibration is used; without one it is not."""

    __tablename__ = "acceptance"
    __table_args__ = (Index(None, "campaign"),)
    calibration_id: Mapped[int] = mapped_column(ForeignKey("calibration.id"), primary_key=True)
    campaign: Mapped[str] = mapped_column(String(64), primary_key=True)
    """Name of the only campaign that it is about; empty for all of the rig that have none of their own."""
    in_use: Mapped[bool]
    decided_at: Mapped[datetime]
    file_id: Mapped[int] = mapped_column(ForeignKey(FileRow.id), unique=True)


class CalibrationUseRow(Table):
    """A file was computed with a calibration, directly or through what it was computed from."""

    __tablename__ = "calibration_use"
    __table_args__ = (Index(None, "file_id"),)
    calibration_id: Mapped[int] = mapped_column(ForeignKey("calibration.id"), primary_key=True)
    file_id: Mapped[int] = mapped_column(ForeignKey(FileRow.id), primary_key=True)
