"""The tables of what jobs wait for: other jobs, their turn, and devices."""

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import BigId, Table
from sms_jobs.catalogue.tables.columns import String, Text
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow


class DependencyRow(Table):
    """One input of a job: a file, or the job that will produce it."""

    __tablename__ = "dependency"
    job_id: Mapped[str] = mapped_column(ForeignKey(JobRow.id), primary_key=True)
    role: Mapped[str] = mapped_column(String(256), primary_key=True)
    source: Mapped[str] = mapped_column(String(32))
    subject: Mapped[str] = mapped_column(String(200))
    producer_id: Mapped[str | None] = mapped_column(ForeignKey(JobRow.id), index=True)
    file_id: Mapped[int | None] = mapped_column(ForeignKey(FileRow.id), index=True)


class OutboxRow(Table):
    """A message that is to be sent once the transaction that wrote this row is committed."""

    __tablename__ = "outbox"
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey(JobRow.id))
    queue: Mapped[str] = mapped_column(String(80))


class QueueRow(Table):
    """A queue that is paused, or was; one without a row never was."""

    __tablename__ = "queue"
    name: Mapped[str] = mapped_column(String(80), primary_key=True)
    paused_at: Mapped[datetime | None]
    reason: Mapped[str] = mapped_column(Text)
    for_room: Mapped[bool]
    """Paused because a disk is full: it goes on by itself once there is room."""


class JobDeviceRow(Table):
    """A device that a job has to hold while it runs."""

    __tablename__ = "job_device"
    job_id: Mapped[str] = mapped_column(ForeignKey(JobRow.id), primary_key=True)
    device: Mapped[str] = mapped_column(String(128), primary_key=True)


class LockRow(Table):
    """A device that is held: by an attempt of a job for as long as that runs, or by a person for a while.

    The row of a device outlives its holder; only `jobs.locks` can say whether it is held.
    """

    __tablename__ = "lock"
    device: Mapped[str] = mapped_column(String(128), primary_key=True)
    job_id: Mapped[str | None] = mapped_column(ForeignKey(JobRow.id), index=True)
    fence: Mapped[int | None]
    holder: Mapped[str | None] = mapped_column(String(128))
    """A person or program that is no job, until `lease_until`."""
    lease_until: Mapped[datetime | None]
    taken_at: Mapped[datetime | None]
