"""The log of what was done with instruments: who, what, when, how long, and how it ended."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sms_jobs.instruments.clock import Clock
from sms_jobs.records.operations import Operation

DONE = "done"
_KEPT = 10_000
_logger = logging.getLogger(__name__)


class OperationLog:
    """Collects operations, and hands each to a sink, such as a file.

    Parameters
    ----------
    clock
        Tells when.
    sink
        Called with each operation when it has ended.
    """

    def __init__(self, clock: Clock, sink: Callable[[Operation], None] | None = None) -> None:
        self._clock = clock
        self._sink = sink
        self._lock = threading.Lock()
        self._operations: deque[Operation] = deque(maxlen=_KEPT)

    @property
    def operations(self) -> tuple[Operation, ...]:
        """Those that have ended, oldest first; the last ten thousand."""
        with self._lock:
            return tuple(self._operations)

    def begin(self, device: str, operation: str, detail: str = "") -> Callable[[BaseException | None], None]:
        """Begin an operation; call what is returned when it has ended, with its error if it failed."""
        time, began = self._clock.now(), self._clock.monotonic()

        def end(error: BaseException | None = None) -> None:
            seconds = self._clock.monotonic() - began
            outcome = DONE if error is None else str(error) or type(error).__name__
            self._enter(Operation(time, device, operation, detail, round(seconds, 4), outcome))

        return end

    @contextmanager
    def operation(self, device: str, operation: str, detail: str = "") -> Iterator[None]:
        """Log what happens inside as one operation, whether it succeeds or not."""
        end = self.begin(device, operation, detail)
        try:
            yield
        except BaseException as error:
            end(error)
            raise
        end(None)

    def _enter(self, operation: Operation) -> None:
        level = logging.INFO if operation.outcome == DONE else logging.WARNING
        _logger.log(
            level, "%s %s %s: %s", operation.device, operation.operation, operation.detail, operation.outcome
        )
        with self._lock:
            self._operations.append(operation)
            if self._sink is not None:
                self._sink(operation)
