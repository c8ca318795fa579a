"""The tables of notifications: who is told of what, and what is still to be sent."""

from datetime import datetime

from sqlalchemy import JSON, ForeignKey, Index, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import BigId, Table
from sms_jobs.catalogue.tables.columns import MessageText, String, Text


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
