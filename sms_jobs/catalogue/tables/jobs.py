"""The tables of jobs, and of what happened to them."""

from datetime import datetime
from typing import Any

from sqlalchemy import BigInteger, ForeignKey, Index, desc
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import BigId, Table
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.columns import MessageText, String
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.records.job import JobState


class JobRow(Table):
    """A job; this row is the only truth about its state."""

    __tablename__ = "job"
    __table_args__ = (
        # In the order in which jobs are claimed, so that a claim looks at one of ten thousand.
        Index("ix_job_next", "state", desc("priority"), "position", "queue"),
        Index(None, "kind", "finished_at"),
        Index(None, "campaign_id", "position"),
        # All that counting the jobs of a campaign or submission asks for.
        Index(None, "campaign_id", "state", "submitted_at"),
        Index(None, "reuse_key", "state"),
        Index(None, "worker_id", "state"),
        # The latest, of all or of those of a kind or in a state, whatever they are about.
        Index(None, "position"),
        Index(None, "kind", "position"),
        Index(None, "state", "position"),
        # How fast jobs come along is asked by every page.
        Index(None, "started_at"),
        Index(None, "finished_at"),
    )
    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32))
    kind_version: Mapped[int]
    campaign_id: Mapped[int] = mapped_column(ForeignKey(CampaignRow.id))
    subject: Mapped[str] = mapped_column(String(200), index=True)
    parameters: Mapped[dict[str, Any]]
    queue: Mapped[str] = mapped_column(String(80))
    priority: Mapped[int] = mapped_column(default=0)
    position: Mapped[int] = mapped_column(BigInteger)
    """Order of submission; smaller is earlier."""
    repeatable: Mapped[bool]
    use_cache: Mapped[bool] = mapped_column(default=True)
    state: Mapped[JobState]
    submitted_at: Mapped[datetime]
    submitted_by: Mapped[str] = mapped_column(String(80), default="", server_default="")
    """The person, account or schedule that asked for it."""
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    attempts: Mapped[int] = mapped_column(default=0)
    crashes: Mapped[int] = mapped_column(default=0)
    tries: Mapped[int] = mapped_column(default=0)
    """How often it failed by what may pass by itself, and was queued again for it."""
    fence: Mapped[int] = mapped_column(default=0)
    """Grows with every claim; an attempt that holds an older one may write nothing."""
    worker_id: Mapped[str | None] = mapped_column(ForeignKey(WorkerRow.id))
    pid: Mapped[int | None]
    stop_asked_at: Mapped[datetime | None]
    """Since when it is to stop; `stop_as` says how it then ends, `stop_reason` why."""
    stop_as: Mapped[JobState | None]
    stop_reason: Mapped[str | None] = mapped_column(MessageText)
    progress: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(MessageText, default="")
    error: Mapped[str | None] = mapped_column(MessageText)
    reuse_key: Mapped[str | None] = mapped_column(String(64))
    reused_from: Mapped[str | None] = mapped_column(ForeignKey("job.id"))


class EventRow(Table):
    """A change of a job's state; rows are only ever added, and sealed by the chain of `AuditRow`."""

    __tablename__ = "event"
    __table_args__ = (
        Index(None, "job_id", "id"),
        Index("ix_event_seal", "seal_id", "id"),
    )
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"))
    at: Mapped[datetime]
    state: Mapped[JobState]
    attempt: Mapped[int]
    message: Mapped[str] = mapped_column(MessageText, default="")
    seal_id: Mapped[int | None] = mapped_column(BigInteger)
    """The link of the chain whose digest holds this row; None until the service has come to it."""
