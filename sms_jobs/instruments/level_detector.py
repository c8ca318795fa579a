"""When a stepped test stays at a load: what a channel has read says at which."""

from __future__ import annotations

from sms_jobs.records.levels import Levels


class LevelDetector:
    """Receives what a channel reads, and says when it has stayed at a level other than the last one.

    Parameters
    ----------
    levels
        What counts as staying at one.
    last
        The level that was recorded last, which does not count; None where there is none.
    """

    def __init__(self, levels: Levels, last: float | None) -> None:
        self._levels = levels
        self._last = last
        self._level: float | None = None
        self._since = 0.0

    def held(self, time_s: float, value: float) -> bool:
        """Take a reading, at a time that goes on, and return whether another level is held now."""
        level = self._levels.near(value)
        if level is None or level != self._level:
            self._level, self._since = level, time_s
        if level is None or level == self._last:
            return False
        return time_s - self._since >= self._levels.for_s
