"""Driver of SCHUNK/Amtec PowerCubes, any number on one link."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

from sms_jobs.errors import DeviceFault, LimitExceeded
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs import powercube as m5
from sms_jobs.instruments.codecs.powercube import Command, Message, Move, Parameter, State
from sms_jobs.instruments.drivers.axes import AXES, AxisName, AxisState
from sms_jobs.instruments.drivers.conversation import Conversation
from sms_jobs.instruments.transports.transport import Transport
from sms_jobs.records.instruments import Stage
from sms_jobs.records.serial_links import SerialLink

Value = TypeVar("Value")

_REACHED_RAD = 1e-3

_EXPLANATIONS = (
    (State.TOW_ERROR, "its tow limit was exceeded: take away what blocks it or lighten it"),
    (State.BEYOND_HARD_LIMIT, "it stands beyond its hard limit: turn it back by hand with the power off"),
    (State.BEYOND_SOFT_LIMIT, "it stands beyond its soft limit: move it back within its range"),
    (State.POWER_FAULT, "its power stage failed: switch the power supply off and on"),
    (State.VOLTAGE, "its motor voltage is too low: check the power supply"),
    (State.LOGIC_VOLTAGE, "its logic voltage is wrong: check the power supply"),
    (State.FET_TEMPERATURE, "its power stage is too hot: let it cool"),
    (State.WINDING_TEMPERATURE, "its winding is too hot: let it cool"),
    (State.SHORT_CIRCUIT, "its motor current is shorted: have it repaired"),
    (State.HALL_SENSOR, "its Hall sensors failed: have it repaired"),
    (State.INTEGRAL_OVERLOAD, "it worked too hard for too long: lighten it or move more gently"),
    (State.CPU_OVERLOAD, "its processor is overloaded: switch it off and on"),
    (State.COMMUNICATION_ERROR, "it lost the connection or its watchdog bit: check the cable"),
    (State.HALTED, "it was halted: reset it"),
    (State.ERROR, "it reports an error that it does not name: reset it, or switch it off and on"),
)


def explain(state: State) -> str:
    """Return what a state word says is wrong and what to do; empty when nothing is wrong."""
    reasons = [text for bit, text in _EXPLANATIONS if bit in state]
    named = [text for text in reasons if not text.startswith(("it was halted", "it reports"))]
    return "; ".join(named or reasons[:1])


@dataclass(frozen=True)
class ModuleFacts:
    """What a module says it is."""

    module: int
    serial_number: int
    version: int

    def __str__(self) -> str:
        return f"PowerCube {self.module}: serial number {self.serial_number}, firmware {self.version:04x}"


class PowerCubes:
    """PowerCubes on one serial link, named by their addresses.

    All methods raise `LinkLost` when a module does not answer.
    """

    def __init__(
        self,
        device: str,
        transport: Transport,
        clock: Clock,
        link: SerialLink,
        checksum: m5.Checksum = "maker",
    ) -> None:
        self.device = device
        self._checksum = checksum
        self._conversation = Conversation(device, transport, clock, m5.PowerCubeDecoder(), link)

    def facts(self, module: int) -> ModuleFacts:
        """Return serial number and firmware version of a module."""
        return ModuleFacts(
            module,
            self._get(module, Parameter.SERIAL_NUMBER, m5.word_value),
            self._get(module, Parameter.VERSION, m5.word_value),
        )

    def close(self) -> None:
        """Let go of the wire."""
        self._conversation.close()

    def state(self, module: int) -> State:
        """Return the state word."""
        return State(self._get(module, Parameter.STATE, m5.word_value))

    def position(self, module: int) -> float:
        """Return the position in rad."""
        return self._get(module, Parameter.POSITION, m5.float_value)

    def reset(self, module: int) -> None:
        """Clear halt, soft limit and most errors."""
        self._ask(module, bytes((Command.RESET,)), "a reset")

    def home(self, module: int) -> None:
        """Begin to look for the home position; done when the state has home OK and ramp end."""
        self._ask(module, bytes((Command.HOME,)), "homing")

    def halt(self, module: int) -> None:
        """Stop at once; the module then waits for a reset."""
        self._ask(module, bytes((Command.HALT,)), "a halt")

    def halt_all(self) -> None:
        """Stop all modules at once; nobody answers."""
        self._broadcast(Command.HALT)

    def start_all(self) -> None:
        """Start the moves of all modules that wait for the common signal; nobody answers."""
        self._broadcast(Command.START)

    def synchronise(self, module: int, *, wait_for_start: bool) -> None:
        """Have a module begin its moves at once, or at `start_all`."""
        word = self._get(module, Parameter.CONFIGURATION, m5.word_value) & 0xFFFF_FFFF
        target = word | m5.SYNCHRONISED if wait_for_start else word & ~m5.SYNCHRONISED
        if target != word:
            self._set(module, m5.set_word(Parameter.CONFIGURATION, target), "its configuration")

    def set_profile(self, module: int, velocity_rad_s: float, acceleration_rad_s2: float) -> None:
        """Set the steady velocity and the ramps of the moves to come."""
        self._set(module, m5.set_float(Parameter.RAMP_VELOCITY, velocity_rad_s), "its ramp velocity")
        self._set(module, m5.set_float(Parameter.RAMP_ACCELERATION, acceleration_rad_s2), "its ramp")

    def set_limits(self, module: int, minimum_rad: float, maximum_rad: float) -> None:
        """Restrict the range of a module."""
        self._set(module, m5.set_float(Parameter.MINIMUM_POSITION, minimum_rad), "its lower limit")
        self._set(module, m5.set_float(Parameter.MAXIMUM_POSITION, maximum_rad), "its upper limit")

    def move_ramp(self, module: int, position_rad: float) -> float:
        """Begin to move to a position with the profile that is set; return where the module is, in rad."""
        data = m5.move(Move.RAMP_EXTENDED, position_rad)
        reply = self._ask(module, data, f"a move to {position_rad:.4f} rad")
        acknowledgement = m5.acknowledgement(reply.data)
        if acknowledgement is None:
            raise DeviceFault(
                f"module {module} of '{self.device}' acknowledges a move with {len(reply.data)} bytes "
                "instead of 8: its firmware is not of the families 25xx and 35xx"
            )
        if m5.ShortState.NOT_OK in acknowledgement.state:
            state = self.state(module)
            why = explain(state) or (
                "it refuses the move" if State.HOME_OK in state else "it was not homed: home it first"
            )
            error = LimitExceeded if State.BEYOND_SOFT_LIMIT in state else DeviceFault
            raise error(f"module {module} of '{self.device}' does not go to {position_rad:.4f} rad: {why}")
        return acknowledgement.position_rad

    def _get(self, module: int, parameter: Parameter, read: Callable[[bytes], Value | None]) -> Value:
        what = parameter.name.lower().replace("_", " ")
        value = read(self._ask(module, m5.get(parameter), f"its {what}").data)
        if value is None:
            raise DeviceFault(f"module {module} of '{self.device}' does not know its {what}")
        return value

    def _set(self, module: int, data: bytes, what: str) -> None:
        reply = self._ask(module, data, f"a change of {what}")
        if reply.data[2:] != bytes((m5.ACCEPTED,)):
            raise DeviceFault(
                f"module {module} of '{self.device}' refuses a change of {what}: check the value in the rig "
                "file"
            )

    def _ask(self, module: int, data: bytes, what: str) -> Message:
        # A reply repeats the command, and the parameter or mode where there is one.
        head = data[:2]

        def answers(message: Message) -> bool:
            return message.from_module and message.module == module and message.data[: len(head)] == head

        frame = m5.encode(Message(module, data), self._checksum)
        return self._conversation.ask(frame, answers, f"{what} (module {module})")

    def _broadcast(self, command: Command) -> None:
        self._conversation.tell(m5.encode(Message(m5.BROADCAST, bytes((command,))), self._checksum))


class PowerCubeAxes:
    """The `Axes` of a stage made of two PowerCubes."""

    def __init__(self, stage: Stage, cubes: PowerCubes) -> None:
        self._stage = stage
        self._cubes = cubes
        self._modules: dict[AxisName, int] = {"pan": stage.pan.module, "tilt": stage.tilt.module}

    def open(self) -> tuple[str, ...]:
        """Greet the modules, clear old errors, set limits and velocities; return what they are."""
        facts = []
        for name in AXES:
            module, axis = self._modules[name], getattr(self._stage, name)
            facts.append(f"{name}: {self._cubes.facts(module)}")
            self._cubes.reset(module)
            self._cubes.set_limits(module, axis.minimum_rad, axis.maximum_rad)
            self._cubes.set_profile(module, axis.velocity_rad_s, axis.acceleration_rad_s2)
            self._cubes.synchronise(module, wait_for_start=self._stage.start == "on-signal")
        return tuple(facts)

    def state(self, axis: AxisName) -> AxisState:
        """Return the present state."""
        module = self._modules[axis]
        state = self._cubes.state(module)
        return AxisState(
            self._cubes.position(module), State.MOTION in state, State.HOME_OK in state, explain(state)
        )

    def resolution_rad(self, axis: AxisName) -> float:
        """Return 0: positions are floating point numbers of far finer encoders."""
        return 0.0

    def home(self, axis: AxisName) -> None:
        """Begin to look for the home position."""
        self._cubes.home(self._modules[axis])

    def move(self, targets_rad: Mapping[AxisName, float]) -> None:
        """Begin to move to positions."""
        for axis, target in targets_rad.items():
            self._cubes.move_ramp(self._modules[axis], target)
        if self._stage.start == "on-signal":
            self._start(targets_rad)

    def stop(self) -> None:
        """Halt all, and each again so that somebody answers."""
        self._cubes.halt_all()
        for module in self._modules.values():
            self._cubes.halt(module)

    def clear(self) -> None:
        """Reset both modules."""
        for module in self._modules.values():
            self._cubes.reset(module)

    def close(self) -> None:
        """Let go of the wire."""
        self._cubes.close()

    def _start(self, targets_rad: Mapping[AxisName, float]) -> None:
        # Nobody answers the signal, so whether it was heard shows in the states.
        for _ in range(3):
            self._cubes.start_all()
            states = {axis: self.state(axis) for axis in targets_rad}
            waiting = [
                axis
                for axis, state in states.items()
                if not (state.moving or state.fault)
                and abs(state.position_rad - targets_rad[axis]) > _REACHED_RAD
            ]
            if not waiting:
                return
        raise DeviceFault(
            f"{' and '.join(waiting)} of '{self._stage.name}' did not start on the common signal: write "
            f"start = 'together' in the rig file for modules without it"
        )
