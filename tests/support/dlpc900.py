"""A DLPC900 behind its bytes, written from its manual and not from our codec: what it is told, it shows."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sms_jobs.instruments.clock import SimulatedClock

REPORT = 64


@dataclass(frozen=True)
class Played:
    """What was lit at a time of the rig's clock, in s, for how long, and how long it was dark then."""

    time_s: float
    levels: NDArray[np.uint8]
    lit_us: int
    dark_us: int


@dataclass
class Peer:
    """The controller and its wire, a `Transport` of reports.

    Attributes
    ----------
    refuses, passes
        A command that it refuses, after so many of them.
    silent
        Whether it answers nothing.
    stale
        Whether an answer to something else comes before each one.
    status
        Of its hardware.
    mode_after
        How often it says the old mode before the new one.
    """

    clock: SimulatedClock
    refuses: int = 0
    passes: int = 0
    silent: bool = False
    stale: bool = False
    status: int = 0x01
    mode_after: int = 0
    mode: int = 1
    running: bool = False
    defined: dict[int, bytes] = field(default_factory=dict)
    entries: int = 0
    images: dict[int, NDArray[np.uint32]] = field(default_factory=dict)
    loaded: list[int] = field(default_factory=list)
    order: list[int] = field(default_factory=list)
    times: int = 0
    commands: list[int] = field(default_factory=list)
    closed: bool = False
    _partial: bytes = b""
    _loading: tuple[int, int, bytes] = (0, 0, b"")
    _answers: deque[bytes] = field(default_factory=deque)
    _begun: float = 0.0

    def write(self, data: bytes) -> None:
        assert len(data) == REPORT
        self._partial += data
        length = int.from_bytes(self._partial[2:4], "little")
        if len(self._partial) < 4 + length:
            return
        flags, sequence, whole = self._partial[0], self._partial[1], self._partial[4 : 4 + length]
        assert not any(self._partial[4 + length :])
        self._partial = b""
        command, arguments = int.from_bytes(whole[:2], "little"), whole[2:]
        self.commands.append(command)
        failed = command == self.refuses and self.passes == 0
        self.passes -= command == self.refuses and self.passes > 0
        told = b"" if failed else self._read(command) if flags & 0x80 else self._do(command, arguments)
        assert flags & 0x40
        if self.silent:
            return
        if self.stale:
            self._answers.append(bytes([0x40, (sequence + 7) % 256, 1, 0, 0xFF]).ljust(REPORT, b"\0"))
        head = bytes([flags | failed << 5, sequence]) + len(told).to_bytes(2, "little")
        self._answers.append((head + told).ljust(REPORT, b"\0"))

    def read(self, timeout_s: float) -> bytes:
        if self._answers:
            return self._answers.popleft()
        self.clock.sleep(timeout_s)
        return b""

    def flush(self) -> None:
        self._answers.clear()

    def close(self) -> None:
        self.closed = True

    def shown(self) -> NDArray[np.uint8] | None:
        """Return what is shown for ever; None in the dark."""
        return self._levels(self.order[0]) if self.running and not self.times else None

    def played(self) -> list[Played]:
        """Return what is played once, with a pulse at the beginning of each."""
        assert self.running
        assert self.times == len(self.order)
        found, time_s = [], self._begun
        for index in self.order:
            lit, dark = (int.from_bytes(self.defined[index][k : k + 3], "little") for k in (2, 6))
            assert not self.defined[index][9] & 1  # the pulse is not switched off
            found.append(Played(time_s, self._levels(index), lit, dark))
            time_s += (lit + dark) / 1e6
        return found

    def _levels(self, index: int) -> NDArray[np.uint8]:
        """Return the pattern as bits of the pixels say it, most significant last."""
        entry = self.defined[index]
        where = int.from_bytes(entry[10:12], "little")
        bits, first = (entry[5] >> 1 & 7) + 1, where >> 11
        return (self.images[where & 0x7FF] >> first & (1 << bits) - 1).astype(np.uint8)

    def _read(self, command: int) -> bytes:
        if command == 0x1A0A:
            return bytes([self.status])
        assert command == 0x1A1B
        self.mode_after -= 1
        return bytes([1 if self.mode_after >= 0 else self.mode])

    def _do(self, command: int, data: bytes) -> bytes:
        match command:
            case 0x1A1B:
                assert not self.running
                self.mode = data[0]
            case 0x1A24:
                self.running, self._begun = data[0] == 2, self.clock.monotonic()
            case 0x1A34:
                assert self.mode == 3
                assert not self.running
                assert len(data) == 12
                self.defined[int.from_bytes(data[:2], "little")] = data
                self.entries = 0  # none holds before all are said to
            case 0x1A31:
                count = int.from_bytes(data[:2], "little")
                assert set(range(count)) <= set(self.defined)
                self.entries = count
            case 0x1A2A:
                self._loading = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:6], "little"), b""
                assert self._loading[0] < 18
                self.loaded.append(self._loading[0])
            case 0x1A2B:
                size = int.from_bytes(data[:2], "little")
                assert len(data) == 2 + size <= 506
                number, total, before = self._loading
                self._loading = number, total, before + data[2:]
                if len(before) + size == total:
                    self.images[number] = decoded(before + data[2:])
            case 0x1A32:
                count, self.times = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:6], "little")
                self.order = np.frombuffer(data[6:], "<u2").tolist()
                assert len(self.order) == count
                assert max(self.order) < self.entries
            case _:
                raise AssertionError(f"{command:#x} is not known here")
        return b""


def decoded(data: bytes) -> NDArray[np.uint32]:
    """Return the pixels of a compressed image, (rows, columns) of 24 bits each."""
    assert data[:4] == b"Spld"
    columns, rows = (int.from_bytes(data[k : k + 2], "little") for k in (4, 6))
    assert int.from_bytes(data[8:12], "little") == len(data)
    assert data[25] == 2  # compressed from line to line, too
    lines: list[list[int]] = [[]]
    at = 48

    def byte() -> int:
        nonlocal at
        at += 1
        return data[at - 1]

    def count(first: int) -> int:
        return first if first < 128 else first & 127 | byte() << 7

    def pixel() -> int:
        return byte() << 16 | byte() << 8 | byte()

    while True:
        first = byte()
        if first:
            number = count(first)
            assert number > 1
            lines[-1] += [pixel()] * number
            continue
        second = byte()
        if second == 0:
            assert len(lines[-1]) == columns
            lines.append([])
        elif second == 1:
            number = count(byte())
            if number == 0:
                break
            start = len(lines[-1])
            lines[-1] += lines[-2][start : start + number]
        else:
            lines[-1] += [pixel() for _ in range(count(second))]
    assert lines.pop() == []
    assert len(lines) == rows
    assert len(data) - at < 4
    return np.array(lines, np.uint32)
