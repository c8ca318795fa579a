"""The tables of load states, and of what was read at them."""

from datetime import datetime

from sqlalchemy import ForeignKey, Index, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.columns import String


class LoadStateRow(Table):
    """One load case of a campaign."""

    __tablename__ = "load_state"
    __table_args__ = (UniqueConstraint("campaign_id", "label"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey(CampaignRow.id))
    label: Mapped[str] = mapped_column(String(64), index=True)
    position: Mapped[int]
    load_n: Mapped[float | None] = mapped_column(index=True)
    """As it was entered from readings, else as it is planned; what was recorded is in `ReadingRow`."""
    displacement_mm: Mapped[float | None]
    planned_load_n: Mapped[float | None] = mapped_column(index=True)
    planned_displacement_mm: Mapped[float | None]
    time: Mapped[datetime | None] = mapped_column(index=True)


class ChannelRow(Table):
    """A scalar reading at a state."""

    __tablename__ = "channel"
    __table_args__ = (Index(None, "name", "value"),)
    state_id: Mapped[int] = mapped_column(ForeignKey("load_state.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    value: Mapped[float]
