"""The tables of the archive's files, and of what they can be found by."""

from datetime import datetime

from sqlalchemy import BigInteger, ForeignKey, Index
from sqlalchemy.orm import Mapped, mapped_column, validates

from sms_jobs.catalogue.tables.base import BigId, Table
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.columns import String, Text
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.records.views import view_of


class FileRow(Table):
    """A sealed file of the archive, whatever it holds."""

    __tablename__ = "file"
    __table_args__ = (
        Index(None, "campaign_id", "source", "state_id", "view", "id"),
        # In these, all that is equal lies in the order of ids, so that the newest are found first.
        Index(None, "campaign_id", "source", "id"),
        Index(None, "source", "id"),
    )
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    source: Mapped[str] = mapped_column(String(32))
    """measurement, calibration, or the kind of job whose result it is."""
    path: Mapped[str] = mapped_column(Text, unique=True)
    content_hash: Mapped[str] = mapped_column(String(64))
    size_bytes: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64), default="")
    """Of the file's bytes; empty where it was not known when the file was entered."""
    media_type: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(index=True)
    recorded_at: Mapped[datetime | None] = mapped_column(index=True)
    """When the last of the recordings that it shows was started; see `catalogue.lineage`."""
    campaign_id: Mapped[int | None] = mapped_column(ForeignKey(CampaignRow.id))
    state_id: Mapped[int | None] = mapped_column(ForeignKey(LoadStateRow.id), index=True)
    view: Mapped[str | None] = mapped_column(String(16))
    camera: Mapped[str | None] = mapped_column(String(8))
    """The reference camera of the view."""
    projector: Mapped[str | None] = mapped_column(String(8))
    job_id: Mapped[str | None] = mapped_column(ForeignKey(JobRow.id), index=True)

    @validates("view")
    def _name_its_sensors(self, _: str, view: str | None) -> str | None:
        seen = None if view is None else view_of(view)
        self.camera = None if seen is None else seen.camera
        self.projector = seen.projector if seen is not None and seen.projectors else None
        return view


class MeasurementRow(Table):
    """What one view recorded at one state."""

    __tablename__ = "measurement"
    __table_args__ = (Index(None, "state_id", "view", "recorded_at"),)
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    state_id: Mapped[int] = mapped_column(ForeignKey(LoadStateRow.id))
    view: Mapped[str] = mapped_column(String(16))
    recorded_at: Mapped[datetime] = mapped_column(index=True)


class ResultRow(Table):
    """What a job computed: one file of its outputs."""

    __tablename__ = "result"
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32), index=True)
    kind_version: Mapped[int]


class StatisticRow(Table):
    """A number that a file can be found by."""

    __tablename__ = "statistic"
    __table_args__ = (Index(None, "name", "value", "file_id"),)
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    value: Mapped[float]


class ReadingRow(Table):
    """What a scalar channel read while the frames of a file, or those behind it, were recorded."""

    __tablename__ = "reading"
    __table_args__ = (Index(None, "name", "value", "file_id"),)
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    value: Mapped[float]


class ProvenanceRow(Table):
    """An edge of the provenance graph: `output` was computed from `input`."""

    __tablename__ = "provenance"
    output_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    role: Mapped[str] = mapped_column(String(256), primary_key=True)
    input_id: Mapped[int] = mapped_column(ForeignKey("file.id"), index=True)


class PinRow(Table):
    """A file that stays whatever a policy says."""

    __tablename__ = "pin"
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    reason: Mapped[str] = mapped_column(Text)
    pinned_at: Mapped[datetime]
