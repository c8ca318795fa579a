"""What a driver asks of whatever carries its bytes."""

from __future__ import annotations

from typing import Protocol


class Transport(Protocol):
    """Carries bytes to a device and back; whatever goes wrong with the wire is a `LinkLost`."""

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, or what arrives first within the time; nothing if nothing does."""
        ...

    def flush(self) -> None:
        """Discard what was not sent yet and what has arrived."""
        ...

    def close(self) -> None:
        """Let go of the wire; may be called again."""
        ...
