"""PowerCubes behind their bytes."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from sms_jobs.instruments.codecs import powercube as m5
from sms_jobs.instruments.codecs.powercube import Command, Message, Move, Parameter, ShortState, State
from sms_jobs.instruments.simulated.serial.axis import SimulatedAxis

_SERIAL_NUMBERS = 21_000
_VERSION = 0x2512
_INCREMENTS = 241_920
_CURRENT_A = 0.4
_MAXIMUM_TOW_RAD = 0.05
_PHASES = {
    "accelerate": State.RAMP_ACCELERATE,
    "steady": State.RAMP_STEADY,
    "decelerate": State.RAMP_DECELERATE,
    "rest": State.RAMP_END,
}
_ERRORS = State.TOW_ERROR | State.BEYOND_SOFT_LIMIT


class _Module:
    """One module: an axis, its parameters, and what makes up its state word."""

    def __init__(self, address: int, axis: SimulatedAxis) -> None:
        self.address = address
        self.axis = axis
        self.halted = False
        self.configuration = 0
        self.waiting: float | None = None
        self._kept = {
            Parameter.MAXIMUM_TOW: _MAXIMUM_TOW_RAD,
            Parameter.MAXIMUM_VELOCITY: axis.velocity_rad_s,
            Parameter.MAXIMUM_ACCELERATION: axis.acceleration_rad_s2,
            Parameter.MAXIMUM_CURRENT: 8.0,
        }

    def state(self, now: float) -> State:
        self.axis.advance(now)
        state = _PHASES[self.axis.phase(now)]
        state |= State.MOTION if self.axis.moving(now) else State(0)
        state |= State.HOME_OK if self.axis.homed else State(0)
        state |= State.HALTED if self.halted else State(0)
        state |= State.TOW_ERROR if self.axis.tow_error else State(0)
        state |= State.BEYOND_SOFT_LIMIT if self.axis.beyond_soft_limit else State(0)
        return state | State.ERROR if state & _ERRORS else state

    def short_state(self, now: float, *, accepted: bool) -> int:
        state = self.state(now)
        short = ShortState(0) if accepted else ShortState.NOT_OK
        short |= ShortState.MOTION if State.MOTION in state else ShortState(0)
        short |= ShortState.RAMP_END if State.RAMP_END in state else ShortState(0)
        return int(short)

    def answer(self, data: bytes, now: float) -> bytes | None:
        """Return the data of the reply to a request; None for what a module does not understand."""
        command = data[0]
        if command == Command.GET and len(data) == 2:
            value = self._read(data[1], now)
            return None if value is None else data + value
        if command == Command.SET and len(data) == 6:
            return data[:2] + bytes((m5.ACCEPTED,)) if self._write(data[1], data[2:]) else None
        if command == Command.MOVE and len(data) >= 6:
            return self._move(data, now)
        if command in (Command.RESET, Command.HOME, Command.HALT, Command.START, Command.WATCHDOG):
            self.obey(command, now)
            return bytes((command, m5.ACCEPTED))
        return None

    def obey(self, command: int, now: float) -> None:
        """Do what needs no values, also for a broadcast to all modules."""
        if command == Command.RESET:
            self.axis.advance(now)
            self.axis.clear()
            self.halted = False
        elif command == Command.HOME and not self.halted:
            self.axis.home(now)
        elif command == Command.HALT:
            self.axis.stop(now)
            self.halted, self.waiting = True, None
        elif command == Command.START and self.waiting is not None:
            target, self.waiting = self.waiting, None
            self.axis.move(target, now)

    def _move(self, data: bytes, now: float) -> bytes | None:
        mode = data[1]
        (target,) = struct.unpack_from("<f", data, 2)
        if mode not in (Move.RAMP, Move.RAMP_EXTENDED):
            return None
        accepted = self.axis.homed and not self.halted and not self.state(now) & State.ERROR
        if accepted and self.configuration & m5.SYNCHRONISED:
            self.waiting = target
        elif accepted:
            accepted = self.axis.move(target, now)
        if mode == Move.RAMP:
            return data[:2] + bytes((m5.ACCEPTED,))
        short = self.short_state(now, accepted=accepted)
        return data[:2] + struct.pack("<fBB", self.axis.position(now), short, 0)

    def _read(self, parameter: int, now: float) -> bytes | None:
        axis = self.axis
        words = {
            Parameter.SERIAL_NUMBER: _SERIAL_NUMBERS + self.address,
            Parameter.DEFAULT_CONFIGURATION: 0,
            Parameter.INCREMENTS_PER_TURN: _INCREMENTS,
            Parameter.STATE: int(self.state(now)),
            Parameter.CONFIGURATION: self.configuration,
        }
        if parameter in words:
            return struct.pack("<I", words[Parameter(parameter)])
        if parameter == Parameter.VERSION:
            return struct.pack("<H", _VERSION)
        if parameter == Parameter.POSITION_AND_STATE:
            return struct.pack("<fBB", axis.position(now), self.short_state(now, accepted=True), 0)
        numbers = {
            Parameter.POSITION: axis.position(now),
            Parameter.TOW: axis.servo(now) - axis.position(now),
            Parameter.VELOCITY: axis.velocity_rad_s if axis.phase(now) == "steady" else 0.0,
            Parameter.CURRENT: _CURRENT_A,
            Parameter.MINIMUM_POSITION: axis.minimum_rad,
            Parameter.MAXIMUM_POSITION: axis.maximum_rad,
            **self._kept,
        }
        return struct.pack("<f", numbers[Parameter(parameter)]) if parameter in numbers else None

    def _write(self, parameter: int, value: bytes) -> bool:
        (number,) = struct.unpack("<f", value)
        if parameter == Parameter.CONFIGURATION:
            self.configuration = int.from_bytes(value, "little")
        elif parameter == Parameter.MINIMUM_POSITION:
            self.axis.minimum_rad = number
        elif parameter == Parameter.MAXIMUM_POSITION:
            self.axis.maximum_rad = number
        elif parameter == Parameter.RAMP_VELOCITY and number > 0.0:
            self.axis.velocity_rad_s = number
        elif parameter == Parameter.RAMP_ACCELERATION and number > 0.0:
            self.axis.acceleration_rad_s2 = number
        elif parameter in self._kept:
            self._kept[Parameter(parameter)] = number
        else:
            return False
        return True


class SimulatedPowerCubes:
    """A chain of PowerCubes.

    Parameters
    ----------
    axes
        By address.
    checksum
        Of the replies; requests are taken in either dialect.
    """

    def __init__(self, axes: Mapping[int, SimulatedAxis], checksum: m5.Checksum = "maker") -> None:
        self._modules = {address: _Module(address, axis) for address, axis in axes.items()}
        self._checksum = checksum
        self._decoder = m5.PowerCubeDecoder()

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes and return the replies."""
        replies = []
        for message in self._decoder.feed(data):
            if message.from_module or not message.data:
                continue
            if message.module == m5.BROADCAST:
                for module in self._modules.values():
                    module.obey(message.data[0], now)
                continue
            addressed = self._modules.get(message.module)
            answer = addressed.answer(message.data, now) if addressed else None
            if answer is not None:
                reply = Message(message.module, answer, from_module=True)
                replies.append(m5.encode(reply, self._checksum))
        return replies

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        """Return nothing: PowerCubes speak when they are asked."""
        return []

    def next_event(self) -> float | None:
        """Return None: they never speak unasked."""
        return None

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        """Return a reply whose BCC is wrong in both dialects."""
        wrong = reply[-2] ^ 0x40
        return reply[:-2] + bytes((wrong,)) + reply[-1:]
