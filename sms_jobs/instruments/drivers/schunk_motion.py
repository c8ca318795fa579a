"""Driver of modules that speak the SCHUNK Motion Protocol, any number on one link."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from sms_jobs.errors import DeviceFault, LimitExceeded
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs import schunk_motion as protocol
from sms_jobs.instruments.codecs.schunk_motion import Command, Frame, Group, ModuleState, Status
from sms_jobs.instruments.drivers.axes import AXES, AxisName, AxisState
from sms_jobs.instruments.drivers.conversation import Conversation
from sms_jobs.instruments.transports.transport import Transport
from sms_jobs.records.instruments import Stage
from sms_jobs.records.serial_links import SerialLink

_KEPT = 100  # messages that nobody fetched


@dataclass(frozen=True)
class Event:
    """What a module said unasked: the position that it reached or was blocked at, an error, an information.

    Attributes
    ----------
    value
        A position in the module's unit, or the number of an error or information.
    """

    time: datetime
    module: int
    command: Command
    value: float


class SchunkMotion:
    """Modules on one serial link, named by their addresses; positions in the unit they are configured to.

    All methods raise `LinkLost` when a module does not answer and `DeviceFault` when it says that the command
    failed.
    """

    def __init__(self, device: str, transport: Transport, clock: Clock, link: SerialLink) -> None:
        self.device = device
        self._clock = clock
        self._events: deque[Event] = deque(maxlen=_KEPT)
        decoder = protocol.SchunkMotionDecoder()
        self._conversation = Conversation(device, transport, clock, decoder, link, self._note)

    def reference(self, module: int) -> None:
        """Begin to look for the reference position."""
        self._succeed(protocol.request(module, Command.REFERENCE), "referencing")

    def move(self, module: int, position: float) -> float:
        """Begin to move to a position; return the seconds that the module thinks it will take, or 0."""
        reply = self._ask(
            protocol.request(module, Command.MOVE_POSITION, position), f"a move to {position:g}"
        )
        if reply.data[: len(protocol.SUCCESS)] == protocol.SUCCESS:
            return 0.0
        return protocol.float_value(reply) or 0.0

    def set_profile(self, module: int, velocity: float, acceleration: float) -> None:
        """Set velocity and acceleration of the moves to come, in the module's unit."""
        for command, value in (
            (Command.SET_TARGET_VELOCITY, velocity),
            (Command.SET_TARGET_ACCELERATION, acceleration),
        ):
            self._succeed(protocol.request(module, command, value), command.name.lower().replace("_", " "))

    def stop(self, module: int) -> None:
        """Stop along the ramp."""
        self._succeed(protocol.request(module, Command.STOP), "a stop")

    def acknowledge(self, module: int) -> None:
        """Acknowledge an error."""
        self._succeed(protocol.request(module, Command.ACKNOWLEDGE), "an acknowledgement")

    def state(self, module: int) -> ModuleState:
        """Return position, velocity, current, status and error number."""
        state = protocol.module_state(self._ask(protocol.get_state(module), "its state"))
        if state is None:
            raise DeviceFault(
                f"module {module} of '{self.device}' describes its state in a form of its own: set it to "
                "report position, velocity and current as floating point numbers"
            )
        return state

    def events(self) -> tuple[Event, ...]:
        """Return what modules said unasked since the last call."""
        self._conversation.listen()
        events = tuple(self._events)
        self._events.clear()
        return events

    def close(self) -> None:
        """Let go of the wire."""
        self._conversation.close()

    def _ask(self, request: Frame, what: str) -> Frame:
        def answers(frame: Frame) -> bool:
            return (
                frame.group in (Group.FROM_MODULE, Group.ERROR)
                and frame.module == request.module
                and frame.command == request.command
            )

        reply = self._conversation.ask(protocol.encode(request), answers, f"{what} (module {request.module})")
        if reply.failed:
            number = reply.data[0] if reply.data else 0
            raise DeviceFault(
                f"module {request.module} of '{self.device}' refuses {what} with error {number:02X} "
                "(hexadecimal): acknowledge it, and look the number up in the module's manual"
            )
        return reply

    def _succeed(self, request: Frame, what: str) -> None:
        if self._ask(request, what).data[: len(protocol.SUCCESS)] != protocol.SUCCESS:
            raise DeviceFault(f"module {request.module} of '{self.device}' does not confirm {what}")

    def _note(self, frame: Frame) -> None:
        if frame.group == Group.TO_MODULE or frame.command not in protocol.SPONTANEOUS:
            return
        number = protocol.float_value(frame)
        value = float(frame.data[0]) if number is None and frame.data else number or 0.0
        self._events.append(Event(self._clock.now(), frame.module, Command(frame.command), value))


class MotionAxes:
    """The `Axes` of a stage made of two such modules."""

    def __init__(self, stage: Stage, modules: SchunkMotion) -> None:
        self._stage = stage
        self._modules = modules
        self._address: dict[AxisName, int] = {"pan": stage.pan.module, "tilt": stage.tilt.module}

    def open(self) -> tuple[str, ...]:
        """Greet the modules, acknowledge old errors, set velocities; return what they are."""
        facts = []
        for name in AXES:
            module, axis = self._address[name], getattr(self._stage, name)
            if Status.ERROR in self._modules.state(module).status:
                self._modules.acknowledge(module)
            unit = self._stage.unit_rad
            self._modules.set_profile(module, axis.velocity_rad_s / unit, axis.acceleration_rad_s2 / unit)
            facts.append(f"{name}: SCHUNK module {module}")
        return tuple(facts)

    def state(self, axis: AxisName) -> AxisState:
        """Return the present state."""
        state = self._modules.state(self._address[axis])
        fault = ""
        if Status.ERROR in state.status:
            fault = (
                f"it reports error {state.error:02X} (hexadecimal): take away what blocks it and acknowledge "
                "the error"
            )
        return AxisState(
            state.position * self._stage.unit_rad,
            Status.MOVING in state.status,
            Status.REFERENCED in state.status,
            fault,
        )

    def resolution_rad(self, axis: AxisName) -> float:
        """Return 0: positions are floating point numbers of far finer encoders."""
        return 0.0

    def home(self, axis: AxisName) -> None:
        """Begin to look for the reference position."""
        self._modules.reference(self._address[axis])

    def move(self, targets_rad: Mapping[AxisName, float]) -> None:
        """Begin to move to positions."""
        for axis, target in targets_rad.items():
            limits = getattr(self._stage, axis)
            if not limits.minimum_rad <= target <= limits.maximum_rad:
                raise LimitExceeded(
                    f"the {axis} axis of '{self._stage.name}' does not go to {target:.4f} rad: its range is "
                    f"{limits.minimum_rad:.4f} .. {limits.maximum_rad:.4f} rad"
                )
            self._modules.move(self._address[axis], target / self._stage.unit_rad)

    def stop(self) -> None:
        """Stop both modules."""
        for module in self._address.values():
            self._modules.stop(module)

    def clear(self) -> None:
        """Acknowledge the errors of both modules."""
        for module in self._address.values():
            if Status.ERROR in self._modules.state(module).status:
                self._modules.acknowledge(module)

    def close(self) -> None:
        """Let go of the wire."""
        self._modules.close()
