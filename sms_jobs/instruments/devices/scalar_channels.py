"""Scalar channels: a load cell on a serial line, a column of a file that other software writes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from datetime import UTC, datetime
from pathlib import Path
from typing import Generic, TypeVar

from sms_jobs.errors import DeviceFault, LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs.scalars import last_value
from sms_jobs.instruments.devices.device import Description
from sms_jobs.instruments.drivers.line_device import ScalarInstrument
from sms_jobs.instruments.operation_log import OperationLog
from sms_jobs.records.instruments import FileChannel, SerialChannel
from sms_jobs.records.operations import Reading

_HEAD_BYTES = 4096
_TAIL_BYTES = 16_384

Channel = TypeVar("Channel", bound=SerialChannel | FileChannel)


class Scalar(ABC, Generic[Channel]):
    """A device that tells one number; channel by channel it is read in its own way."""

    def __init__(self, channel: Channel, clock: Clock, log: OperationLog | None = None) -> None:
        self._channel = channel
        self._clock = clock
        self._log = log or OperationLog(clock)

    @property
    def name(self) -> str:
        """Its name in the rig."""
        return self._channel.name

    @property
    def unit(self) -> str:
        """Unit of its readings."""
        return self._channel.unit

    def connect(self) -> None:
        """Read it once, which shows whether it answers, or whether its file is there and is being written."""
        with self._log.operation(self.name, "connect"):
            self.reading()

    @abstractmethod
    def close(self) -> None:
        """Let go of it."""

    def describe(self) -> Description:
        """Return what it reads, and in what it measures."""
        return Description(self.name, *self._said(), ((self.name, self.unit),))

    @abstractmethod
    def _said(self) -> tuple[str, tuple[str, ...]]:
        """Return of what kind it is, and facts about it."""

    def read(self) -> tuple[Reading, ...]:
        """Return the present value."""
        return (self.reading(),)

    @abstractmethod
    def reading(self) -> Reading:
        """Return the present value and when it was so."""


class SerialScalar(Scalar[SerialChannel]):
    """An instrument that tells one number on a serial line."""

    def __init__(
        self,
        channel: SerialChannel,
        instrument: ScalarInstrument,
        clock: Clock,
        log: OperationLog | None = None,
    ) -> None:
        super().__init__(channel, clock, log)
        self._instrument = instrument

    def close(self) -> None:
        """Let go of it."""
        self._instrument.close()

    def _said(self) -> tuple[str, tuple[str, ...]]:
        a_unit = self._channel.reported_unit or "count"
        return "serial channel", (f"{self._channel.scale:g} {self._channel.unit} a {a_unit}",)

    def reading(self) -> Reading:
        """Return the present value and when it came."""
        value = self._instrument.value()
        return Reading(self.name, value, self.unit, self._clock.now())


class FileScalar(Scalar[FileChannel]):
    """The last line of a file that other software appends to."""

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""

    def _said(self) -> tuple[str, tuple[str, ...]]:
        return "file channel", (f"column {self._channel.column} of {self._channel.path}",)

    def reading(self) -> Reading:
        """Return the last value and when the file was written.

        Raises
        ------
        LinkLost
            There is no file, no value in its last line, or it was written too long ago.
        DeviceFault
            It has no such column.
        """
        path = Path(self._channel.path)
        try:
            written, head, tail = _both_ends(path)
        except OSError as error:
            raise LinkLost(
                f"{path}, which '{self.name}' reads, cannot be read ({error.strerror}): start the software "
                "that writes it, or correct the path in the rig file"
            ) from error
        age = (self._clock.now() - written).total_seconds()
        if 0.0 < self._channel.stale_after_s < age:
            raise LinkLost(
                f"{path}, which '{self.name}' reads, was last written {age:.0f} s ago, more than "
                f"{self._channel.stale_after_s:g} s: see that its software records"
            )
        value = last_value(self._channel, head, tail)
        if value is None:
            raise LinkLost(
                f"the last line of {path} has no number in column '{self._channel.column}', which "
                f"'{self.name}' reads: see what its software writes there"
            )
        return Reading(self.name, value, self.unit, written)


class ChannelValue:
    """A scalar channel as a plain number, for whoever wants no more."""

    def __init__(self, channel: SerialScalar | FileScalar) -> None:
        self._channel = channel

    @property
    def unit(self) -> str:
        """Unit of its values."""
        return self._channel.unit

    def read(self) -> float:
        """Return the present value."""
        return self._channel.reading().value

    def reading(self) -> Reading:
        """Return the present value and when it was so."""
        return self._channel.reading()


def _both_ends(path: Path) -> tuple[datetime, str, str]:
    """Return when a file was written, its beginning, and its end."""
    with path.open("rb") as file:
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        head = file.read(_HEAD_BYTES)
        size = file.seek(0, 2)
        file.seek(max(0, size - _TAIL_BYTES))
        tail = file.read(_TAIL_BYTES)
    if size > _TAIL_BYTES and b"\n" not in tail:
        raise DeviceFault(f"the last line of {path} is longer than {_TAIL_BYTES} bytes: it is no table")
    return written, head.decode("utf-8", "replace"), tail.decode("utf-8", "replace")
