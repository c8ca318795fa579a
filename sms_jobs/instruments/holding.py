"""When a load is held or drops, and when a counter stands still: what a channel has read says so."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

from sms_jobs.records.events import Event


@dataclass(frozen=True)
class Hold:
    """What counts as holding a load.

    Attributes
    ----------
    target, tolerance
        The channel is within `tolerance` of `target`, both in its unit.
    for_s
        How long it must have stayed there.
    """

    target: float
    tolerance: float
    for_s: float


class Detector(Protocol):
    """Receives what a channel reads, and says when what is waited for has come."""

    def held(self, time_s: float, value: float) -> bool:
        """Take a reading, at a time that goes on, and return whether it is there now."""
        ...


class HoldDetector:
    """Receives what a channel reads, and says when the load is held."""

    def __init__(self, hold: Hold) -> None:
        self._hold = hold
        self._since: float | None = None

    def held(self, time_s: float, value: float) -> bool:
        """Take a reading, at a time that goes on, and return whether the load is held now."""
        if not abs(value - self._hold.target) <= self._hold.tolerance:  # nor is what is no number
            self._since = None
            return False
        if self._since is None:
            self._since = time_s
        return time_s - self._since >= self._hold.for_s


class StandstillDetector:
    """Receives what a counter reads, and says when it has come to a number and stood still since.

    Parameters
    ----------
    count
        Which it must have reached.
    for_s
        How long its reading must not have changed.
    """

    def __init__(self, count: float, for_s: float) -> None:
        self._count = count
        self._for_s = for_s
        self._last: float | None = None
        self._since = 0.0

    def held(self, time_s: float, value: float) -> bool:
        """Take a reading, at a time that goes on, and return whether the counter stands there now."""
        if value != self._last:  # nor is what is no number ever equal
            self._last, self._since = value, time_s
        return value >= self._count and time_s - self._since >= self._for_s


class EventDetector:
    """Receives what a channel reads, and says when an event has come; for good, though it may pass.

    A drop is told from the highest reading of its time, and from one reading to the next however far apart
    they are, so that a channel that is read rarely does not hide it.
    """

    def __init__(self, event: Event) -> None:
        self._event = event
        self._recent: deque[tuple[float, float]] = deque()
        self._come = False

    def held(self, time_s: float, value: float) -> bool:
        """Take a reading, at a time that goes on, and return whether the event has come."""
        self._come = self._come or self._comes(time_s, value)
        return self._come

    def _comes(self, time_s: float, value: float) -> bool:
        event = self._event
        if event.comes != "drops":
            return value > event.limit if event.comes == "above" else value < event.limit
        while len(self._recent) > 1 and self._recent[0][0] < time_s - event.within_s:
            self._recent.popleft()
        if any(before - value >= event.limit for _, before in self._recent):
            return True
        self._recent.append((time_s, value))
        return False
