"""Types of columns that hold the same on SQLite and on PostgreSQL, and refuse the same.

SQLite would take a name of any length, and letters that PostgreSQL cannot hold.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import sqlalchemy
from sqlalchemy import DateTime, Dialect, TypeDecorator

from sms_jobs.errors import InvalidInput
from sms_jobs.records.texts import DOCUMENT_LETTERS, checked_text, harmless, unstored
from sms_jobs.records.times import checked_time


class Sought(TypeDecorator[str]):
    """A text that a column is compared with: of any length, since nothing is stored of it."""

    impl = sqlalchemy.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Return what every database can compare with; what cannot be stored is found nowhere."""
        return unstored(value) if isinstance(value, str) else value


class String(TypeDecorator[str]):
    """A text of at most so many letters, all of which can be printed."""

    impl = sqlalchemy.String
    cache_ok = True

    def __init__(self, length: int) -> None:
        super().__init__(length)
        self.length = length

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Refuse what cannot be stored everywhere."""
        return checked_text(value, "a name", self.length) if isinstance(value, str) else value

    def coerce_compared_value(self, op: Any, value: Any) -> Any:
        """Return the type of what the column is compared with."""
        return Sought()


class Text(TypeDecorator[str]):
    """A text that somebody has written."""

    impl = sqlalchemy.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Refuse what cannot be stored everywhere."""
        return value if value is None else checked_text(value, "a text", DOCUMENT_LETTERS)

    def coerce_compared_value(self, op: Any, value: Any) -> Any:
        """Return the type of what the column is compared with."""
        return Sought()


class MessageText(TypeDecorator[str]):
    """A message of the program: what cannot be stored, say from a library, is replaced, never refused."""

    impl = sqlalchemy.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Return what can be stored everywhere."""
        return value if value is None else harmless(value[:DOCUMENT_LETTERS])


class UtcDateTime(TypeDecorator[datetime]):
    """A time with zone, kept as UTC; SQLite stores it without the zone and gets it back on reading."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Refuse a time without zone, or one that no test can have had; convert the rest to UTC."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise InvalidInput(f"a time without time zone cannot be stored: {value}")
        return checked_time(value, "a time").astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the time in UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)
