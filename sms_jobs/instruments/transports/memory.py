"""A wire in memory to a simulated device, on any clock."""

from __future__ import annotations

from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.simulated.serial.line import SimulatedLine


class MemoryWire:
    """A `Transport` to a simulator; on a simulated clock nobody waits."""

    def __init__(self, line: SimulatedLine, clock: Clock) -> None:
        self._line = line
        self._clock = clock

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        self._line.send(data, self._clock.monotonic())

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, or what arrives first within the time."""
        deadline = self._clock.monotonic() + timeout_s
        while True:
            now = self._clock.monotonic()
            arrived = self._line.take(now)
            if arrived or now >= deadline:
                return arrived
            arrival = self._line.next_arrival()
            # A little later, so that rounding does not leave the last byte on the wire.
            until = deadline if arrival is None else min(deadline, max(arrival, now) + 1e-6)
            self._clock.sleep(until - now)

    def flush(self) -> None:
        """Discard what has arrived; what is on the wire still comes."""
        self._line.take(self._clock.monotonic())

    def close(self) -> None:
        """Let go of the wire."""
