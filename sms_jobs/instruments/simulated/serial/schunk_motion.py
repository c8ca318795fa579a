"""Modules that speak the SCHUNK Motion Protocol, behind their bytes."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from sms_jobs.instruments.codecs import schunk_motion as protocol
from sms_jobs.instruments.codecs.schunk_motion import Command, Frame, Group, Status
from sms_jobs.instruments.simulated.serial.axis import SimulatedAxis

_TOW_ERROR = 0xDE
_SOFT_LIMIT_ERROR = 0xD5
_FAST_STOP_ERROR = 0xD9
_NOT_REFERENCED = 0x05
_CURRENT = 0.5


class _Module:
    """One module, which tells unasked when it has arrived or is blocked."""

    def __init__(self, address: int, axis: SimulatedAxis, unit_rad: float) -> None:
        self.address = address
        self.axis = axis
        self.tells_at: float | None = None
        self._fast_stopped = False
        self._unit = unit_rad

    def answer(self, frame: Frame, now: float) -> Frame:
        self.axis.advance(now)
        numbers = struct.unpack(f"<{len(frame.data) // 4}f", frame.data[: len(frame.data) // 4 * 4])
        if frame.command == Command.GET_STATE:
            return self._reply(frame, self._state(now))
        if frame.command == Command.MOVE_POSITION and numbers:
            return self._move(frame, numbers[0] * self._unit, now)
        if frame.command == Command.SET_TARGET_VELOCITY and numbers and numbers[0] > 0.0:
            self.axis.velocity_rad_s = numbers[0] * self._unit
        elif frame.command == Command.SET_TARGET_ACCELERATION and numbers and numbers[0] > 0.0:
            self.axis.acceleration_rad_s2 = numbers[0] * self._unit
        elif frame.command == Command.REFERENCE:
            self.axis.home(now)
            self.tells_at = None
        elif frame.command in (Command.STOP, Command.FAST_STOP):
            self.axis.stop(now)
            self.tells_at = None
            self._fast_stopped |= frame.command == Command.FAST_STOP
        elif frame.command == Command.ACKNOWLEDGE:
            self.axis.clear()
            self._fast_stopped = False
        else:
            return self._failure(frame, 0x04)
        return self._reply(frame, protocol.SUCCESS)

    def tell(self, now: float) -> Frame | None:
        """Return what it says unasked so far."""
        if self.tells_at is None or now < self.tells_at:
            return None
        self.tells_at = None
        self.axis.advance(now)
        blocked = self.axis.tow_error or self.axis.beyond_soft_limit
        command = Command.BLOCKED if blocked else Command.REACHED
        position = struct.pack("<f", self.axis.position(now) / self._unit)
        return Frame(Group.FROM_MODULE, self.address, command, position)

    def _move(self, frame: Frame, target_rad: float, now: float) -> Frame:
        if not self.axis.homed:
            return self._failure(frame, _NOT_REFERENCED)
        if self._fast_stopped or not self.axis.move(target_rad, now):
            return self._failure(frame, self._error())
        self.tells_at = self.axis.ends
        return self._reply(frame, struct.pack("<f", self.axis.ends - now))

    def _error(self) -> int:
        if self._fast_stopped:
            return _FAST_STOP_ERROR
        if self.axis.tow_error:
            return _TOW_ERROR
        return _SOFT_LIMIT_ERROR if self.axis.beyond_soft_limit else 0

    def _state(self, now: float) -> bytes:
        status = Status.REFERENCED if self.axis.homed else Status(0)
        status |= Status.MOVING if self.axis.moving(now) else Status.MOVE_END
        status |= Status.ERROR if self._error() else Status(0)
        velocity = self.axis.velocity_rad_s if self.axis.phase(now) == "steady" else 0.0
        position = self.axis.position(now)
        return struct.pack(
            "<3fBB", position / self._unit, velocity / self._unit, _CURRENT, status, self._error()
        )

    def _reply(self, frame: Frame, data: bytes) -> Frame:
        return Frame(Group.FROM_MODULE, self.address, frame.command, data)

    def _failure(self, frame: Frame, number: int) -> Frame:
        return Frame(Group.FROM_MODULE, self.address, frame.command, bytes((number,)))


class SimulatedMotionModules:
    """Modules on one line.

    Parameters
    ----------
    axes
        By address.
    unit_rad
        What they count positions in.
    """

    def __init__(self, axes: Mapping[int, SimulatedAxis], unit_rad: float) -> None:
        self._modules = {address: _Module(address, axis, unit_rad) for address, axis in axes.items()}
        self._decoder = protocol.SchunkMotionDecoder()

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes and return the replies."""
        return [
            protocol.encode(self._modules[frame.module].answer(frame, now))
            for frame in self._decoder.feed(data)
            if frame.group == Group.TO_MODULE and frame.module in self._modules
        ]

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        """Return what modules tell unasked, with the times."""
        messages = []
        for module in self._modules.values():
            sent_at, frame = module.tells_at, module.tell(now)
            if frame is not None and sent_at is not None:
                messages.append((sent_at, protocol.encode(frame)))
        return messages

    def next_event(self) -> float | None:
        """Return when a module will have arrived."""
        return min((m.tells_at for m in self._modules.values() if m.tells_at is not None), default=None)

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        """Return a reply with a wrong CRC."""
        return reply[:-1] + bytes((reply[-1] ^ 0x40,))
