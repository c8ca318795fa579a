"""The table of what has happened beside jobs, for those who follow it."""

from datetime import UTC, datetime

from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import BigId, Table
from sms_jobs.catalogue.tables.columns import MessageText, String


class ChangeRow(Table):
    """A change of a planned recording, a calibration or a schedule; rows are only ever added.

    It names what has changed and is no part of it: that may be gone, and how it stands its own rows say.
    """

    __tablename__ = "change"
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    topic: Mapped[str] = mapped_column(String(16))
    """See `records.shown.changes.Followed`."""
    name: Mapped[str] = mapped_column(String(200))
    campaign: Mapped[str] = mapped_column(String(64))
    """Name of the campaign that it is about; empty for what is about several, or about none."""
    state: Mapped[str] = mapped_column(String(16))
    message: Mapped[str] = mapped_column(MessageText)
    at: Mapped[datetime] = mapped_column(default=lambda: datetime.now(UTC))
