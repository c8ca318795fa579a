"""The channels of a rig, read again and again while frames come in, and the event that they may tell of."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf

from sms_jobs.errors import InstrumentError
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.holding import EventDetector
from sms_jobs.instruments.kept_streams import LineLog
from sms_jobs.instruments.protocols import Channel, recorded_value
from sms_jobs.records.events import Event
from sms_jobs.records.numbers import is_excessive

_READS_EVERY_S = 0.02
_UNREAD_S = 5.0
"""So long may the channel of an event fail to be read before its event is given up."""
_SYNC_EVERY_S = 1.0
_SAME_S = 1e-3
"""Times of one reading, which are told by two clocks, differ by less."""


@dataclass
class ChannelWatch:
    """Reads channels in a thread of its own until it is stopped.

    Attributes
    ----------
    channels
        By name.
    clock
        Of the rig; all times are by it.
    zero_s
        The start of the stream, from which the times of the log count.
    log
        Takes every new reading.
    event, come
        What is waited for, and who is told, once, when it was there.
    """

    channels: Mapping[str, Channel]
    clock: Clock
    zero_s: float
    log: LineLog
    event: Event | None
    come: Callable[[float], None]
    _stopped: threading.Event = field(default_factory=threading.Event, init=False)
    _read_until: dict[str, float] = field(init=False)

    def __post_init__(self) -> None:
        self._read_until = dict.fromkeys(self.channels, -inf)

    def run(self) -> None:
        """Read until somebody stops it.

        A channel that does not answer has no readings meanwhile. A file is read for as long as its software
        has written nothing new, and that counts once.

        Raises
        ------
        InstrumentError
            The channel of the event has not answered for 5 s.
        StorageFull
            The disk has no room for a reading.
        """
        detector = None if self.event is None else EventDetector(self.event)
        answered_s = synced_s = time.monotonic()
        while not self._stopped.is_set():
            for name, channel in self.channels.items():
                awaited = self.event is not None and detector is not None and name == self.event.channel
                try:
                    new = self._new_reading(name, channel)
                except InstrumentError as error:
                    if awaited and time.monotonic() > answered_s + _UNREAD_S:
                        raise InstrumentError(
                            f"{name}, which is waited for, could not be read for {_UNREAD_S:g} s: {error}"
                        ) from error
                    continue
                answered_s = time.monotonic() if awaited else answered_s
                if awaited and new is not None and detector is not None and detector.held(*new):
                    detector = None
                    self.come(new[0])
            if time.monotonic() > synced_s + _SYNC_EVERY_S:
                synced_s = time.monotonic()
                self.log.sync()
            self._stopped.wait(_READS_EVERY_S)

    def stop(self) -> None:
        """Have it stop."""
        self._stopped.set()

    def wait_until_read_after(self, time_s: float, at_most_s: float) -> None:
        """Return when every channel has read something after a time, -inf for any, or after a while."""
        until = time.monotonic() + at_most_s
        while time.monotonic() < until and not all(t > time_s for t in self._read_until.values()):
            time.sleep(_READS_EVERY_S)

    def _new_reading(self, name: str, channel: Channel) -> tuple[float, float] | None:
        """Return when a channel read what, in its unit; None where it is no reading, or the one before.

        It is logged in the unit of its name, as recordings have it.
        """
        reading = channel.reading()
        age_s = max((self.clock.now() - reading.time).total_seconds(), 0.0)
        time_s = self.clock.monotonic() - age_s
        if time_s <= self._read_until[name] + _SAME_S or is_excessive(reading.value):
            return None
        self._read_until[name] = time_s
        value = recorded_value(name, channel, reading.value)
        self.log.write(name, f"{time_s - self.zero_s:.6f}", repr(value))
        return time_s, reading.value
