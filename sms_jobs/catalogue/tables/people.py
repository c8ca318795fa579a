"""The tables of people: who they are, how they come in, what they did, and what they are told."""

from datetime import datetime
from typing import Any

from sqlalchemy import JSON, ForeignKey, Index, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.models import BigId, Table
from sms_jobs.catalogue.tables.columns import MessageText, String, Text


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


class SubscriptionRow(Table):
    """Where notifications of some sorts are sent."""

    __tablename__ = "subscription"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    channel: Mapped[str] = mapped_column(String(16))
    """`webhook` or `mail`."""
    address: Mapped[str] = mapped_column(Text)
    secret: Mapped[str] = mapped_column(Text)
    """Signs what is sent to a webhook; never shown."""
    topics: Mapped[list[str]] = mapped_column(JSON)
    created_at: Mapped[datetime]


class OccurrenceRow(Table):
    """Something that happened and that subscribers are to be told, entered with the change that it is.

    It is gone in the transaction that makes `NotificationRow`s of it and of others like it.
    """

    __tablename__ = "occurrence"
    __table_args__ = (Index(None, "topic", "campaign", "at"),)
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    topic: Mapped[str] = mapped_column(String(32))
    campaign: Mapped[str] = mapped_column(String(64))
    about: Mapped[str] = mapped_column(Text)
    """Which job or schedule, as people are told."""
    at: Mapped[datetime]
    message: Mapped[str] = mapped_column(MessageText)


class NotificationRow(Table):
    """Something that a subscriber is told once; its key makes a second one impossible."""

    __tablename__ = "notification"
    __table_args__ = (
        UniqueConstraint("subscription_id", "key"),
        Index(None, "sent_at", "next_try_at"),
    )
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    subscription_id: Mapped[int] = mapped_column(ForeignKey("subscription.id", ondelete="CASCADE"))
    topic: Mapped[str] = mapped_column(String(32))
    campaign: Mapped[str] = mapped_column(String(64))
    """Name of the campaign that it is about; empty for what is about none."""
    key: Mapped[str] = mapped_column(String(128))
    """What is told: the same thing has the same key."""
    subject: Mapped[str] = mapped_column(Text)
    text: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime]
    tries: Mapped[int] = mapped_column(default=0)
    next_try_at: Mapped[datetime | None]
    """None once it was sent or given up."""
    sent_at: Mapped[datetime | None]
    error: Mapped[str | None] = mapped_column(MessageText)
