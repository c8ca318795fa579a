"""What instruments give back: values with their times, and lines of the operation log."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class Reading:
    """A value that a device reported, and when."""

    name: str
    value: float
    unit: str
    time: datetime


@dataclass(frozen=True)
class Operation:
    """A line of the operation log.

    Attributes
    ----------
    time
        When it began.
    device, operation
        Who did what.
    detail
        With which values, in the words of the log.
    seconds
        How long it took.
    outcome
        `done`, or the sentence of the error.
    """

    time: datetime
    device: str
    operation: str
    detail: str
    seconds: float
    outcome: str
