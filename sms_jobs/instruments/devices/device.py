"""What every device offers, and how one is waited for: in the manner of ophyd-async, without its loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from sms_jobs.errors import SmsError, WaitTimedOut
from sms_jobs.instruments.clock import Clock
from sms_jobs.records.operations import Reading

POLLS_EVERY_S = 0.05


@dataclass(frozen=True)
class Description:
    """What a device is.

    Attributes
    ----------
    name, kind
        In the rig, and in words.
    facts
        What it reported of itself when it was connected: serial numbers, firmware, resolutions.
    units
        Of its readings, by their names.
    """

    name: str
    kind: str
    facts: tuple[str, ...]
    units: tuple[tuple[str, str], ...]


class Device(Protocol):
    """Any device. All methods raise `LinkLost` when it does not answer and `DeviceFault` when it fails."""

    @property
    def name(self) -> str:
        """Its name in the rig."""
        ...

    def connect(self) -> None:
        """Greet it and set it up."""
        ...

    def close(self) -> None:
        """Let go of it; may be called again."""
        ...

    def describe(self) -> Description:
        """Return what it is; it must be connected."""
        ...

    def read(self) -> tuple[Reading, ...]:
        """Return its present values."""
        ...


class Status:
    """Something that was started and takes time: how far it is, and whether it succeeded.

    Nothing goes on by itself: `update` takes the next step, and `wait` takes all, with pauses. So there are
    no threads, and on a simulated clock nobody waits.

    Parameters
    ----------
    what
        For messages: "'stage' to move".
    steps
        Yields progress from 0 to 1, and ends when it is done; its exceptions are its failure.
    timeout_s
        Longest time in all, which ends it with `WaitTimedOut`.
    finished
        Called once at the end, with the error if it failed.
    """

    def __init__(
        self,
        what: str,
        steps: Iterator[float],
        clock: Clock,
        timeout_s: float,
        finished: Callable[[SmsError | None], None] | None = None,
    ) -> None:
        self._what = what
        self._steps = steps
        self._clock = clock
        self._timeout_s = timeout_s
        self._deadline = clock.monotonic() + timeout_s
        self._finished = finished
        self.progress = 0.0
        self.done = False
        self.error: SmsError | None = None

    def update(self) -> bool:
        """Take the next step; return whether it is over, well or not."""
        if self.done:
            return True
        try:
            if self._clock.monotonic() > self._deadline:
                raise WaitTimedOut(
                    f"waited {self._timeout_s:.3g} s for {self._what}, which is {100.0 * self.progress:.0f} "
                    "% done: stop it and see what holds it up"
                )
            self.progress = max(self.progress, min(1.0, next(self._steps)))
        except StopIteration:
            self._end(None)
        except SmsError as error:
            self._end(error)
        return self.done

    def wait(self) -> None:
        """Take all steps; raise the error that it ends with."""
        while not self.update():
            self._clock.sleep(POLLS_EVERY_S)
        if self.error is not None:
            raise self.error

    def _end(self, error: SmsError | None) -> None:
        self.done, self.error = True, error
        if error is None:
            self.progress = 1.0
        if self._finished is not None:
            self._finished(error)


def at_once(what: str, action: Callable[[], None], clock: Clock, settle_s: float = 0.0) -> Status:
    """Return the status of something that is done when it was said, and perhaps a little later."""

    def steps() -> Iterator[float]:
        action()
        ready = clock.monotonic() + settle_s
        while clock.monotonic() < ready:
            yield 0.5

    status = Status(what, steps(), clock, settle_s + 60.0)
    status.update()
    return status
