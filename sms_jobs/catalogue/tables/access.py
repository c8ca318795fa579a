"""The table of how people come in: tokens and sessions."""

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.columns import String, Text
from sms_jobs.catalogue.tables.people import PersonRow


class AccessRow(Table):
    """A token of a person for programs, or a session of a browser; the secret itself is nowhere."""

    __tablename__ = "access"
    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    person_id: Mapped[int] = mapped_column(ForeignKey(PersonRow.id), index=True)
    sort: Mapped[str] = mapped_column(String(16))
    """`token` or `session`."""
    label: Mapped[str] = mapped_column(Text)
    secret_hash: Mapped[str] = mapped_column(String(64), unique=True)
    """SHA-256 of 32 random bytes, which nobody can guess."""
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
    used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
