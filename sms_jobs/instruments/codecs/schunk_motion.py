"""SCHUNK Motion Protocol over a serial line: `group id DLen command data CRClo CRChi`."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag

_LONGEST = 64
"""Of DLen: the longest frame of the protocol that is used or met has 45."""
SUCCESS = b"OK"


class Group(IntEnum):
    """Who speaks, and how."""

    ERROR = 0x03
    TO_MODULE = 0x05
    FROM_MODULE = 0x07


class Command(IntEnum):
    """The command of a frame; the last five are also sent by modules on their own."""

    FAST_STOP = 0x90
    STOP = 0x91
    REFERENCE = 0x92
    GET_STATE = 0x95
    SET_TARGET_VELOCITY = 0xA0
    SET_TARGET_ACCELERATION = 0xA1
    MOVE_POSITION = 0xB0
    MOVE_CURRENT = 0xB3
    MOVE_VELOCITY = 0xB5
    ERROR = 0x88
    INFO = 0x8A
    ACKNOWLEDGE = 0x8B
    BLOCKED = 0x93
    REACHED = 0x94


SPONTANEOUS = frozenset((Command.ERROR, Command.INFO, Command.BLOCKED, Command.REACHED))


class Status(IntFlag):
    """State byte of a module."""

    REFERENCED = 0x01
    MOVING = 0x02
    PROGRAM_MODE = 0x04
    WARNING = 0x08
    ERROR = 0x10
    BRAKE = 0x20
    MOVE_END = 0x40
    POSITION_REACHED = 0x80


@dataclass(frozen=True)
class Frame:
    """A frame of the protocol.

    Attributes
    ----------
    group
        Direction and kind.
    module
        Address, 1 to 255.
    command
        One of `Command`, or another byte.
    data
        After the command.
    """

    group: int
    module: int
    command: int
    data: bytes = b""

    @property
    def failed(self) -> bool:
        """Whether a reply says that the command failed: DLen is 2, and the byte is the error's number."""
        return self.group == Group.ERROR or (self.group == Group.FROM_MODULE and len(self.data) == 1)


def crc16(data: bytes) -> int:
    """Return the CRC-16/ARC of bytes: polynomial 8005 reflected, initial value 0."""
    crc = 0
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def encode(frame: Frame) -> bytes:
    """Return the bytes of a frame."""
    head = bytes((frame.group, frame.module, len(frame.data) + 1, frame.command)) + frame.data
    return head + crc16(head).to_bytes(2, "little")


class SchunkMotionDecoder:
    """Finds frames in a stream of bytes.

    The protocol has no byte that only begins a frame. What looks like the beginning of a long frame does not
    hide a whole one behind it.

    Attributes
    ----------
    refused
        How many bytes belonged to no frame.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._bytes = bytearray()

    def reset(self) -> None:
        """Forget the beginning of a frame."""
        self._bytes.clear()

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes and return the frames that they complete."""
        frames = []
        self._bytes += data
        at, incomplete = 0, None
        while at < len(self._bytes):
            length = self._length(at)
            if length is None:
                at += 1
            elif at + length > len(self._bytes):
                incomplete = at if incomplete is None else incomplete
                at += 1
            else:
                frame = self._frame(at, length)
                if frame is None:
                    at += 1
                    continue
                frames.append(frame)
                self.refused += at
                del self._bytes[: at + length]
                at, incomplete = 0, None
        left = len(self._bytes) if incomplete is None else incomplete
        self.refused += left
        del self._bytes[:left]
        return frames

    def _length(self, at: int) -> int | None:
        """Return how long a frame that begins there would be; None where none begins."""
        head = self._bytes[at : at + 3]
        if head[0] not in (Group.ERROR, Group.TO_MODULE, Group.FROM_MODULE):
            return None
        if len(head) > 1 and head[1] == 0:
            return None
        if len(head) < 3:
            return 6  # the shortest
        return head[2] + 5 if 1 <= head[2] <= _LONGEST else None

    def _frame(self, at: int, length: int) -> Frame | None:
        piece = bytes(self._bytes[at : at + length])
        if crc16(piece[:-2]) != int.from_bytes(piece[-2:], "little"):
            return None
        return Frame(piece[0], piece[1], piece[3], piece[4:-2])


def request(module: int, command: Command, *values: float) -> Frame:
    """Return a request with numbers."""
    return Frame(Group.TO_MODULE, module, command, struct.pack(f"<{len(values)}f", *values))


def get_state(module: int) -> Frame:
    """Return the question for position, velocity and current, to be answered once."""
    return Frame(Group.TO_MODULE, module, Command.GET_STATE, struct.pack("<fB", 0.0, 7))


@dataclass(frozen=True)
class ModuleState:
    """Answer to `get_state`; position and velocity in the unit that the module is configured to."""

    position: float
    velocity: float
    current: float
    status: Status
    error: int


def module_state(frame: Frame) -> ModuleState | None:
    """Read the answer to `get_state`; None when it is none."""
    if frame.command != Command.GET_STATE or len(frame.data) != 14:
        return None
    position, velocity, current, status, error = struct.unpack("<3fBB", frame.data)
    return ModuleState(position, velocity, current, Status(status), error)


def float_value(frame: Frame) -> float | None:
    """Return the number of a frame, such as the position that was reached; None when it has none."""
    return float(struct.unpack_from("<f", frame.data)[0]) if len(frame.data) == 4 else None


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
        table.append(crc)
    return tuple(table)


_TABLE = _crc_table()
