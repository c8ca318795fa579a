"""The table of people who have a name here."""

from datetime import datetime

from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.columns import String


class PersonRow(Table):
    """Somebody who uses this installation by name."""

    __tablename__ = "person"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    role: Mapped[str] = mapped_column(String(16))
    password: Mapped[str | None] = mapped_column(String(256))
    """Hashed by argon2; None for who comes in by other means alone."""
    identity: Mapped[str | None] = mapped_column(String(256), unique=True)
    """By which an identity provider knows the person: issuer and subject."""
    active: Mapped[bool] = mapped_column(default=True)
    created_at: Mapped[datetime]
    failures: Mapped[int] = mapped_column(default=0)
    """Wrong passwords since the last right one."""
    locked_until: Mapped[datetime | None]
