"""The table of questions to the archive that are kept."""

from datetime import datetime

from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.columns import String, Text


class SavedQueryRow(Table):
    """A question to the archive that somebody wants to ask again."""

    __tablename__ = "saved_query"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    text: Mapped[str] = mapped_column(Text)
    saved_at: Mapped[datetime]
