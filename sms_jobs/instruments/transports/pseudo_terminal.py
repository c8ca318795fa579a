"""A simulated device on a pseudo-terminal, where any serial terminal can talk to it."""

from __future__ import annotations

import contextlib
import os
import select
import threading
from types import TracebackType

from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.simulated.serial.line import SimulatedLine

_LISTENS_FOR_S = 0.5


class PseudoTerminal:
    """Serves a simulated line on a pseudo-terminal until it is closed.

    Parameters
    ----------
    line
        With the device at its end; its time is that of the real clock.

    Attributes
    ----------
    path
        Of the port that a driver or a terminal opens.
    """

    def __init__(self, line: SimulatedLine) -> None:
        import tty  # not on Windows, which has no pseudo-terminals

        self._line = line
        self._clock = RealClock()
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.path = os.ttyname(self._theirs)
        self._closing, self._close = os.pipe()
        self._thread = threading.Thread(
            target=self._serve, name=f"simulated device on {self.path}", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> PseudoTerminal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the device and its terminal; may be called again."""
        if self._thread.is_alive():
            os.write(self._close, b"x")
            self._thread.join()
            for descriptor in (self._ours, self._theirs, self._closing, self._close):
                os.close(descriptor)

    def _serve(self) -> None:
        while True:
            now = self._clock.monotonic()
            self._write(self._line.take(now))
            arrival = self._line.next_arrival()
            wait = _LISTENS_FOR_S if arrival is None else min(_LISTENS_FOR_S, max(0.0, arrival - now) + 1e-4)
            ready, _, _ = select.select([self._ours, self._closing], [], [], wait)
            if self._closing in ready:
                return
            if self._ours in ready:
                self._line.send(os.read(self._ours, 4096), self._clock.monotonic())

    def _write(self, data: bytes) -> None:
        # Without a reader the terminal's buffer fills. A device on a wire would talk on: what does not fit is
        # lost.
        with contextlib.suppress(BlockingIOError):
            if data:
                os.write(self._ours, data)
