"""The tables of people: who they are, and how they come in."""

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.models import Table
from sms_jobs.catalogue.tables.columns import String, Text


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


class AccessRow(Table):
    """A token of a person for programs, or a session of a browser; the secret itself is nowhere."""

    __tablename__ = "access"
    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    person_id: Mapped[int] = mapped_column(ForeignKey("person.id"), index=True)
    sort: Mapped[str] = mapped_column(String(16))
    """`token` or `session`."""
    label: Mapped[str] = mapped_column(Text)
    secret_hash: Mapped[str] = mapped_column(String(64), unique=True)
    """SHA-256 of 32 random bytes, which nobody can guess."""
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
    used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
