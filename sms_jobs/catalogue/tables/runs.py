"""The tables of named runs: which jobs a run has, and what was asked of them."""

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.columns import String, Text
from sms_jobs.catalogue.tables.jobs import JobRow


class RunRow(Table):
    """A name for what the jobs of some submissions give."""

    __tablename__ = "run"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[datetime]
    created_by: Mapped[str] = mapped_column(String(80))
    kept_at: Mapped[datetime | None]
    """Since when no policy removes its results; None where one may."""
    reason: Mapped[str] = mapped_column(Text, default="")
    """Why it is kept."""


class RunSubmissionRow(Table):
    """One submission under the name of a run, as it was asked for."""

    __tablename__ = "run_submission"
    id: Mapped[int] = mapped_column(primary_key=True)
    run_id: Mapped[int] = mapped_column(ForeignKey("run.id"), index=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey(CampaignRow.id))
    submitted_at: Mapped[datetime]
    submitted_by: Mapped[str] = mapped_column(String(80))
    asked: Mapped[dict[str, Any]]
    """Values of the parameters that were given, by `kind.name`."""


class RunJobRow(Table):
    """A job of a run, whose results, made or reused, belong to it."""

    __tablename__ = "run_job"
    run_id: Mapped[int] = mapped_column(ForeignKey("run.id"), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey(JobRow.id), primary_key=True, index=True)
