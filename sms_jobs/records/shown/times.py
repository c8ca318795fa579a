"""Times as they are shown: none where nobody knows one."""

from __future__ import annotations

from datetime import datetime

from sms_jobs.records.times import UNTIMED


def known_time(moment: datetime | None) -> datetime | None:
    """Return a time; None for the mark of what has none."""
    return None if moment == UNTIMED else moment


def valid_from(moment: datetime) -> str:
    """Say from when on a calibration is valid, or is taken as valid because nobody knows its time."""
    told = moment.isoformat(" ", "seconds")
    if moment == UNTIMED:
        return f"taken as valid from {told} on, since its time is not known"
    return f"valid from {told} on"


def with_unknown_times(text: str) -> str:
    """Return a text that names times, in which the mark of what has none is said in words."""
    return text.replace(str(UNTIMED), "a time that is not known")
