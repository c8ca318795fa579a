"""The table of who did what."""

from datetime import datetime
from typing import Any

from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import BigId, Table
from sms_jobs.catalogue.tables.columns import String, Text


class AuditRow(Table):
    """A link of the chain that says who did what; rows are only ever added.

    `digest` covers the row and the digest of the row before it, so that none can be changed, put in or taken
    away without all behind it.
    """

    __tablename__ = "audit"
    id: Mapped[int] = mapped_column(BigId, primary_key=True, autoincrement=False)
    """One more than that of the row before."""
    at: Mapped[datetime]
    who: Mapped[str] = mapped_column(String(64), index=True)
    role: Mapped[str] = mapped_column(String(16))
    via: Mapped[str] = mapped_column(String(16))
    origin: Mapped[str] = mapped_column(String(128))
    action: Mapped[str] = mapped_column(String(64), index=True)
    arguments: Mapped[dict[str, Any]]
    reason: Mapped[str] = mapped_column(Text)
    digest: Mapped[str] = mapped_column(String(64))
