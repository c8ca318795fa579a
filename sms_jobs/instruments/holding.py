"""When a load is held: a channel has stayed near its target for a while."""

from __future__ import annotations

from dataclasses import dataclass


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
