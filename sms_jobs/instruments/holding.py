"""When a load is held, and when a counter stands still: what a channel has read for a while says so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


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
