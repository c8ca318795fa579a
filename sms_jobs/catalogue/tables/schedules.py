"""The tables of schedules: what is submitted at which times, and what became of each."""

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.columns import MessageText, String


class ScheduleRow(Table):
    """Work to be submitted at times that an expression gives."""

    __tablename__ = "schedule"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    expression: Mapped[str] = mapped_column(String(128))
    time_zone: Mapped[str] = mapped_column(String(64))
    request: Mapped[dict[str, Any]]
    missed_fire: Mapped[str] = mapped_column(String(16))
    grace_s: Mapped[float]
    paused: Mapped[bool] = mapped_column(default=False)
    created_at: Mapped[datetime]


class ScheduleFireRow(Table):
    """One firing of a schedule; its key makes a second one impossible."""

    __tablename__ = "schedule_fire"
    schedule_id: Mapped[int] = mapped_column(ForeignKey("schedule.id"), primary_key=True)
    fire_time: Mapped[datetime] = mapped_column(primary_key=True)
    outcome: Mapped[str] = mapped_column(MessageText)
