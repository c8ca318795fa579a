"""For how long something has not changed, by the clock of who looks.

Clocks of two machines differ, are set, and stand still with a machine that sleeps. Here no time is ever
compared that somebody else has written: who looks remembers what it saw, and counts only while it looks.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)


class Stillness(Generic[Key]):
    """Remembers values, and for how long each has been the same.

    Parameters
    ----------
    longest_step_s
        How much one look may add: when looks were further apart, nobody knows what happened between.
    """

    def __init__(self, longest_step_s: float) -> None:
        self._longest_step_s = longest_step_s
        self._seen: dict[Key, tuple[object, float]] = {}
        self._looked_at: float | None = None

    def look(self, values: Mapping[Key, object], now: float) -> dict[Key, float]:
        """Return the seconds for which each value has been seen unchanged; what is not given is forgotten.

        Parameters
        ----------
        now
            Seconds of a monotonic clock.
        """
        since = 0.0 if self._looked_at is None else min(now - self._looked_at, self._longest_step_s)
        self._looked_at = now
        before, self._seen = self._seen, {}
        for key, value in values.items():
            known, still_s = before.get(key, (value, -since))
            self._seen[key] = (value, still_s + since if known == value else 0.0)
        return {key: still_s for key, (_, still_s) in self._seen.items()}
