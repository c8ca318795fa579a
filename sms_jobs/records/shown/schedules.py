"""What schedules are going to do."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime

MOST_A_DAY = 100
"""Firings of one schedule and day that are counted."""


@dataclass(frozen=True)
class FiringsOfDay:
    """When one schedule fires on one day.

    Attributes
    ----------
    campaign, kinds
        What it submits.
    first, count
        The first time, and how many there are; of `MOST_A_DAY` there may be more.
    """

    day: date
    schedule: str
    campaign: str
    kinds: tuple[str, ...]
    first: datetime
    count: int
