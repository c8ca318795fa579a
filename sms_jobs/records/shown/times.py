"""Times as they are shown: none where nobody knows one."""

from __future__ import annotations

from datetime import datetime

from sms_jobs.records.times import UNTIMED


def known_time(moment: datetime | None) -> datetime | None:
    """Return a time; None for the mark of what has none."""
    return None if moment == UNTIMED else moment
