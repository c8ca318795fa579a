"""Times that can be stored, compared across zones, and shown everywhere."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final

from sms_jobs.errors import InvalidInput

EARLIEST: Final = datetime(1900, 1, 1, tzinfo=UTC)
LATEST: Final = datetime(2200, 1, 1, tzinfo=UTC)
"""Within both, a time of any zone can be brought into any other."""
UNTIMED: Final = datetime(2000, 1, 1, tzinfo=UTC)
"""What a simulated measurement bears whose state has no time: a clock would make every run differ."""


def checked_time(moment: datetime, what: str) -> datetime:
    """Return a time; raise `InvalidInput` when it has no zone, or no test can have had it."""
    if moment.tzinfo is None:
        raise InvalidInput(
            f"{what} should be a time with its zone, as in 2026-05-04T10:00:00+02:00, not '{moment}'"
        )
    if not EARLIEST <= moment < LATEST:
        raise InvalidInput(
            f"{what}, {moment.isoformat()}, is not in the years {EARLIEST.year} to {LATEST.year - 1}"
        )
    return moment


def parsed_time(text: str, what: str) -> datetime:
    """Return the time that a text says, with its zone; raise `InvalidInput` for anything else."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InvalidInput(
            f"{what} should be a time with its zone, as in 2026-05-04T10:00:00+02:00, not '{text[:60]}'"
        ) from None
    return checked_time(moment, what)
