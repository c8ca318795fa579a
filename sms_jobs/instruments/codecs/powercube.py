"""SCHUNK/Amtec PowerCubes over RS-232, M5 dialect (firmware 25xx and 35xx).

A frame is `STX h0 h1 data[0..8] BCC ETX`. Header and data and BCC are stuffed: 02, 03 and 10 become 10 and
the byte + 80 (all hexadecimal). Numbers are little-endian, positions in rad, velocities in rad/s.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Literal

Checksum = Literal["maker", "carmen"]

STX, ETX, DLE = 0x02, 0x03, 0x10
_STUFFED = frozenset((STX, ETX, DLE))
_FROM_COMPUTER, _FROM_MODULE = 0x04, 0x08
_LONGEST = 8
ACCEPTED = 0x64
"""Last byte of a plain acknowledgement."""
BROADCAST = 0
SYNCHRONISED = 0x0800_0000
"""Bit of the configuration word: moves wait for the common start signal."""


class Command(IntEnum):
    """First byte of a message's data."""

    RESET = 0x00
    HOME = 0x01
    HALT = 0x02
    WATCHDOG = 0x07
    SET = 0x08
    GET = 0x0A
    MOVE = 0x0B
    START = 0x0F


class Move(IntEnum):
    """Second byte of a move; the later four are answered with position and short state."""

    RAMP = 0x04
    STEP = 0x06
    VELOCITY = 0x07
    CURRENT = 0x08
    RAMP_EXTENDED = 0x0E
    STEP_EXTENDED = 0x10
    VELOCITY_EXTENDED = 0x11
    CURRENT_EXTENDED = 0x12


class Parameter(IntEnum):
    """Second byte of a question or a setting."""

    SERIAL_NUMBER = 0x1A
    DEFAULT_CONFIGURATION = 0x1B
    INCREMENTS_PER_TURN = 0x1C
    VERSION = 0x1D
    STATE = 0x27
    CONFIGURATION = 0x39
    POSITION = 0x3C
    TOW = 0x3F
    MAXIMUM_TOW = 0x40
    VELOCITY = 0x41
    MINIMUM_POSITION = 0x45
    MAXIMUM_POSITION = 0x46
    MAXIMUM_VELOCITY = 0x48
    MAXIMUM_ACCELERATION = 0x4A
    MAXIMUM_CURRENT = 0x4C
    CURRENT = 0x4D
    RAMP_VELOCITY = 0x4F
    RAMP_ACCELERATION = 0x50
    POSITION_AND_STATE = 0x62


class State(IntFlag):
    """State word of a module."""

    ERROR = 1 << 0
    HOME_OK = 1 << 1
    HALTED = 1 << 2
    POWER_FAULT = 1 << 3
    TOW_ERROR = 1 << 4
    COMMUNICATION_ERROR = 1 << 5
    REFERENCE_SWITCH = 1 << 6
    LIMIT_SWITCH_1 = 1 << 7
    LIMIT_SWITCH_2 = 1 << 8
    BRAKE = 1 << 9
    CURRENT_LIMIT = 1 << 10
    MOTION = 1 << 11
    RAMP_ACCELERATE = 1 << 12
    RAMP_STEADY = 1 << 13
    RAMP_DECELERATE = 1 << 14
    RAMP_END = 1 << 15
    STEP_IN_PROGRESS = 1 << 16
    BUFFER_FULL = 1 << 17
    VOLTAGE = 1 << 18
    FET_TEMPERATURE = 1 << 19
    WINDING_TEMPERATURE = 1 << 20
    SHORT_CIRCUIT = 1 << 21
    HALL_SENSOR = 1 << 22
    INTEGRAL_OVERLOAD = 1 << 23
    CPU_OVERLOAD = 1 << 24
    BEYOND_HARD_LIMIT = 1 << 25
    BEYOND_SOFT_LIMIT = 1 << 26
    LOGIC_VOLTAGE = 1 << 27


class ShortState(IntFlag):
    """State byte of extended acknowledgements."""

    NOT_OK = 0x01
    REFERENCE_SWITCH = 0x02
    LIMIT_SWITCH_1 = 0x04
    LIMIT_SWITCH_2 = 0x08
    MOTION = 0x10
    RAMP_END = 0x20
    IN_PROGRESS = 0x40
    BUFFER_FULL = 0x80


@dataclass(frozen=True)
class Message:
    """A message to or from a module.

    Attributes
    ----------
    module
        Address 1 to 31; 0 is all, who do not answer.
    data
        At most 8 bytes.
    from_module
        The direction.
    """

    module: int
    data: bytes
    from_module: bool = False


def encode(message: Message, checksum: Checksum = "maker") -> bytes:
    """Return the frame of a message."""
    direction = _FROM_MODULE if message.from_module else _FROM_COMPUTER
    body = bytes(
        (message.module >> 3 | direction, (message.module & 7) << 5 | len(message.data), *message.data)
    )
    body += bytes((block_check(body, checksum),))
    stuffed = bytearray((STX,))
    for byte in body:
        stuffed += bytes((DLE, byte + 0x80)) if byte in _STUFFED else bytes((byte,))
    stuffed.append(ETX)
    return bytes(stuffed)


def block_check(body: bytes, checksum: Checksum) -> int:
    """Return the BCC of header and data: the maker's, or the CARMEN family's, which leaves the header out."""
    if checksum == "maker":
        total = sum(body)
        return (total + (total >> 8)) & 0xFF
    module = (body[0] & 3) << 3 | body[1] >> 5
    return (module + sum(body[2:])) & 0xFF


class PowerCubeDecoder:
    """Finds messages in a stream of bytes; either checksum will do.

    Attributes
    ----------
    refused
        How many frames began and were no messages.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._body: bytearray | None = None
        self._escaped = False

    def reset(self) -> None:
        """Forget the beginning of a frame."""
        self._body, self._escaped = None, False

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes and return the messages that they complete."""
        messages = []
        for byte in data:
            if byte == STX:  # never inside a frame, since it would be stuffed
                self._refuse_unless_empty()
                self._body, self._escaped = bytearray(), False
            elif self._body is None:
                continue
            elif byte == ETX:
                message = None if self._escaped else _message(bytes(self._body))
                self.reset()
                if message is None:
                    self.refused += 1
                else:
                    messages.append(message)
            elif self._escaped:
                self._body.append((byte - 0x80) & 0xFF)
                self._escaped = False
            elif byte == DLE:
                self._escaped = True
            else:
                self._body.append(byte)
            if self._body is not None and len(self._body) > _LONGEST + 3:
                self._refuse_unless_empty()
                self.reset()
        return messages

    def _refuse_unless_empty(self) -> None:
        self.refused += self._body is not None


def _message(body: bytes) -> Message | None:
    if len(body) < 3 or body[1] & 0x0F != len(body) - 3 or body[1] & 0x0F > _LONGEST:
        return None
    if body[0] & ~0x03 not in (_FROM_COMPUTER, _FROM_MODULE, _FROM_COMPUTER | _FROM_MODULE):
        return None
    if body[-1] not in (block_check(body[:-1], "maker"), block_check(body[:-1], "carmen")):
        return None
    return Message((body[0] & 3) << 3 | body[1] >> 5, body[2:-1], bool(body[0] & _FROM_MODULE))


def get(parameter: Parameter) -> bytes:
    """Return the data of a question."""
    return bytes((Command.GET, parameter))


def set_float(parameter: Parameter, value: float) -> bytes:
    """Return the data of a setting."""
    return struct.pack("<BBf", Command.SET, parameter, value)


def set_word(parameter: Parameter, value: int) -> bytes:
    """Return the data of a setting of 32 bits."""
    return struct.pack("<BBI", Command.SET, parameter, value)


def move(mode: Move, value: float) -> bytes:
    """Return the data of a move to a position (rad), or at a velocity (rad/s) or a current (A)."""
    return struct.pack("<BBf", Command.MOVE, mode, value)


def float_value(data: bytes) -> float | None:
    """Return the number of the reply to a question; None when it has none."""
    return float(struct.unpack_from("<f", data, 2)[0]) if len(data) == 6 else None


def word_value(data: bytes) -> int | None:
    """Return the whole number, of 16 or 32 bits, of the reply to a question; None when it has none."""
    return int.from_bytes(data[2:], "little") if len(data) in (4, 6) else None


@dataclass(frozen=True)
class Acknowledgement:
    """What the extended acknowledgement of a move says: where the axis is, in rad, and its short state."""

    position_rad: float
    state: ShortState


def acknowledgement(data: bytes) -> Acknowledgement | None:
    """Read an extended acknowledgement, or the reply to `POSITION_AND_STATE`; None when it is neither."""
    if len(data) != 8:
        return None
    position, short, _digital_inputs = struct.unpack_from("<fBB", data, 2)
    return Acknowledgement(position, ShortState(short))
