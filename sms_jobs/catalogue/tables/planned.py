"""The table of what is to be recorded while a test goes on."""

from datetime import datetime
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, false
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.columns import MessageText, String
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import LoadStateRow


class PlannedRecordingRow(Table):
    """A state that is to be recorded once its trigger says so, and what has become of that."""

    __tablename__ = "planned_recording"
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey(CampaignRow.id), index=True)
    state_id: Mapped[int] = mapped_column(ForeignKey(LoadStateRow.id), unique=True)
    position: Mapped[int]
    """In which order those of a campaign come."""
    trigger: Mapped[dict[str, Any]]
    """See `records.triggers`."""
    ask: Mapped[bool]
    process: Mapped[bool]
    status: Mapped[str] = mapped_column(String(16), index=True)
    """See `records.shown.planned_recordings.Status`."""
    held: Mapped[bool]
    revision: Mapped[int]
    """Of its trigger; what was found to hold for another one begins nothing."""
    planned_at: Mapped[datetime]
    planned_by: Mapped[str] = mapped_column(String(80))
    due_at: Mapped[datetime | None]
    """When it was due, once it has started."""
    job_id: Mapped[str | None] = mapped_column(ForeignKey(JobRow.id), unique=True)
    seen: Mapped[float | None]
    """What its channel read at `seen_at`, where it waits for one."""
    seen_at: Mapped[datetime | None]
    note: Mapped[str | None] = mapped_column(MessageText)
    """What keeps it from being watched, or was found when it was recorded."""
    look: Mapped[bool] = mapped_column(server_default=false())
    """Whether there is to be a quick look at it once it is recorded."""
    stop_if: Mapped[list[dict[str, Any]]] = mapped_column(JSON, server_default="[]")
    """Limits beyond which that holds the plan, see `records.gauge_limits`."""
    awaited: Mapped[bool] = mapped_column(server_default=false())
    """Whether nothing behind it begins before its quick look was checked against the limits."""
    stopped_by: Mapped[str | None] = mapped_column(MessageText)
    """Which limit has held the plan after it, until somebody lets it go on."""


class PlannedLevelsRow(Table):
    """A campaign that is given one more state, and a recording of it, at each load that is held."""

    __tablename__ = "planned_levels"
    campaign_id: Mapped[int] = mapped_column(
        ForeignKey(CampaignRow.id), primary_key=True, autoincrement=False
    )
    channel: Mapped[str] = mapped_column(String(64))
    unit: Mapped[str] = mapped_column(String(64))
    """Of the channel's readings and of the numbers here."""
    step: Mapped[float]
    tolerance: Mapped[float]
    for_s: Mapped[float]
    """See `records.levels.Levels`."""
    ask: Mapped[bool]
    process: Mapped[bool]
    look: Mapped[bool]
    stop_if: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    """As of a `PlannedRecordingRow`, which each state is given."""
    held: Mapped[bool]
    revision: Mapped[int]
    """Of what is waited for; what was found to hold for another one adds nothing."""
    last: Mapped[float | None]
    """The level at which the last state was added; None before the first."""
    last_state_id: Mapped[int | None] = mapped_column(ForeignKey(LoadStateRow.id))
    last_file_id: Mapped[int] = mapped_column(BigInteger)
    """The newest measurement that there was then, 0 for none: one that came later tells where the test is."""
    planned_at: Mapped[datetime]
    planned_by: Mapped[str] = mapped_column(String(80))
    seen: Mapped[float | None]
    """What the channel read at `seen_at`."""
    seen_at: Mapped[datetime | None]
    note: Mapped[str | None] = mapped_column(MessageText)
    """What keeps the channel from being watched, or a state from being added."""
