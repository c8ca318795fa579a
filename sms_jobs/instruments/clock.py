"""Clocks: a real one, and one that tests and simulators advance themselves."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Protocol


class Clock(Protocol):
    """Time that goes on, and time of day."""

    def monotonic(self) -> float:
        """Return seconds since some moment; never goes back."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        ...

    def now(self) -> datetime:
        """Return the time of day, with zone."""
        ...


class RealClock:
    """The clock of this computer."""

    def monotonic(self) -> float:
        """Return seconds since some moment; never goes back."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        if seconds > 0.0:
            time.sleep(seconds)

    def now(self) -> datetime:
        """Return the time of day in UTC."""
        return datetime.now(UTC)


@dataclass
class SimulatedClock:
    """A clock that stands still until somebody sleeps; nobody waits.

    Attributes
    ----------
    started
        The time of day at 0 s.
    """

    started: datetime = datetime(2000, 1, 1, tzinfo=UTC)
    _seconds: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def monotonic(self) -> float:
        """Return the seconds that have been slept."""
        return self._seconds

    def sleep(self, seconds: float) -> None:
        """Advance."""
        with self._lock:
            self._seconds += max(0.0, seconds)

    def now(self) -> datetime:
        """Return the simulated time of day."""
        return self.started + timedelta(seconds=self._seconds)
