"""The wire to a simulated device: how long bytes take, and what befalls them on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from sms_jobs.records.serial_links import LINK_FAULTS, Fault

_BITS_A_BYTE = 10  # start, 8 data, stop
_THINKS_FOR_S = 0.002


class SimulatedDevice(Protocol):
    """A device as its wire knows it. Times are in s, of the clock of the wire, and never go back."""

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes, which may be half a request or three, and return the replies."""
        ...

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        """Return what it sends unasked so far and has not returned before, with the times."""
        ...

    def next_event(self) -> float | None:
        """Return when it will next speak unasked, if it knows."""
        ...

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        """Return a reply whose checksum is wrong; garbled where the protocol has none."""
        ...


@dataclass(frozen=True)
class _Flight:
    """Bytes on the wire; the first begins to arrive at `begins`."""

    begins: float
    data: bytes


class SimulatedLine:
    """A wire with a device at its end.

    Parameters
    ----------
    device
        At the far end.
    baud_rate
        In bits per second; sets how long bytes travel.
    faults
        Those of the wire are committed here; others are the device's.
    """

    def __init__(self, device: SimulatedDevice, baud_rate: int, faults: Sequence[Fault] = ()) -> None:
        self._device = device
        self._byte_s = _BITS_A_BYTE / baud_rate
        self._faults = [fault for fault in faults if fault.fault in LINK_FAULTS]
        self._replies = 0
        self._requests = 0
        self._unplugged = False
        self._flights: list[_Flight] = []

    def send(self, data: bytes, now: float) -> None:
        """Carry bytes to the device."""
        self._requests += 1
        self._unplugged = self._without_cable(self._requests)
        if self._unplugged:
            return
        arrives = now + len(data) * self._byte_s
        for reply in self._device.receive(data, arrives):
            self._replies += 1
            self._carry_back(reply, arrives + _THINKS_FOR_S)

    def take(self, now: float) -> bytes:
        """Return the bytes that have arrived from the device so far."""
        for sent_at, unasked in self._device.speak(now):
            self._replies += 1
            # Of a device that is never asked, the messages are counted instead of the requests.
            if not (self._unplugged if self._requests else self._without_cable(self._replies)):
                self._carry_back(unasked, sent_at)
        arrived, left = b"", []
        for flight in sorted(self._flights, key=lambda f: f.begins):
            count = min(len(flight.data), max(0, int((now - flight.begins) / self._byte_s + 1e-6)))
            arrived += flight.data[:count]
            if count < len(flight.data):
                left.append(_Flight(flight.begins + count * self._byte_s, flight.data[count:]))
        self._flights = left
        return arrived

    def next_arrival(self) -> float | None:
        """Return when the next message has arrived as a whole, or the device speaks; None for silence."""
        times = [f.begins + len(f.data) * self._byte_s for f in self._flights]
        event = self._device.next_event()
        if event is not None:
            times.append(event)
        return min(times, default=None)

    def _without_cable(self, count: int) -> bool:
        return any(fault.fault == "unplugged" and fault.befalls(count) for fault in self._faults)

    def _carry_back(self, reply: bytes, now: float) -> None:
        for fault in self._faults:
            if not fault.befalls(self._replies):
                continue
            middle = len(reply) // 2
            if fault.fault == "dropped-byte":
                reply = reply[:middle] + reply[middle + 1 :]
            elif fault.fault == "garbled-byte":
                # The top bit: never ASCII, and always another sum.
                reply = reply[:middle] + bytes([reply[middle] ^ 0x80]) + reply[middle + 1 :]
            elif fault.fault == "wrong-checksum":
                reply = self._device.with_wrong_checksum(reply)
            elif fault.fault == "late-reply":
                now += fault.amount
        self._flights.append(_Flight(now, reply))
