"""Driver of PTU-46 pan-tilt units."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sms_jobs.errors import DeviceFault, LimitExceeded
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs import ptu46
from sms_jobs.instruments.codecs.lines import LineDecoder
from sms_jobs.instruments.drivers.axes import AXES, AxisName, AxisState
from sms_jobs.instruments.drivers.conversation import Conversation
from sms_jobs.instruments.transports.transport import Transport
from sms_jobs.records.instruments import Axis, Stage
from sms_jobs.records.serial_links import SerialLink

_LETTERS: dict[AxisName, ptu46.AxisLetter] = {"pan": "p", "tilt": "t"}
_ROUNDS = 5
_FINEST_RAD, _COARSEST_RAD = 1e-6, 5e-3
"""Of a count: units of this family have 12 to 185 seconds of arc, which is 6e-5 to 9e-4 rad."""


class Ptu46:
    """A PTU-46 unit.

    All methods raise `LinkLost` when it does not answer and `DeviceFault` when it refuses.
    """

    def __init__(self, device: str, transport: Transport, clock: Clock, link: SerialLink) -> None:
        self.device = device
        decoder = LineDecoder(ptu46.TERMINATOR)
        self._conversation = Conversation(device, transport, clock, decoder, link)

    def command(self, name: str, value: int | None = None) -> None:
        """Send a command."""
        self._ask(name, value, lambda reply: True)

    def ask(self, name: str) -> float:
        """Return the number that answers a question."""
        reply = self._ask(name, None, lambda reply: reply.value is not None or not reply.accepted)
        return reply.value or 0.0

    def constants(self, names: Sequence[str]) -> dict[str, float]:
        """Return numbers that do not change, once all were read twice alike: replies have no checksum.

        They are asked for in rounds, so that one disturbance does not change the same number twice.
        """
        values = [self.ask(name) for name in names]
        for _ in range(_ROUNDS):
            before, values = values, [self.ask(name) for name in names]
            if values == before:
                return dict(zip(names, values, strict=True))
        raise DeviceFault(
            f"'{self.device}' reports different limits and resolutions each time: check its cable"
        )

    def _ask(self, name: str, value: int | None, answers: Callable[[ptu46.Reply], bool]) -> ptu46.Reply:
        text = f"{name}{'' if value is None else value}"

        def fits(line: str) -> bool:
            reply = ptu46.reply(line)
            return reply is not None and answers(reply)

        line = self._conversation.ask(ptu46.command(name, value), fits, f"'{text}'")
        reply = ptu46.reply(line)
        if reply is None or not reply.accepted:
            raise DeviceFault(
                f"'{self.device}' refuses '{text}': {reply.text if reply else line}; compare the limits and "
                "velocities in the rig file with the unit's"
            )
        return reply

    def close(self) -> None:
        """Let go of the wire."""
        self._conversation.close()


@dataclass
class _Scale:
    """What the unit says of an axis: angle of a count, range in counts; and where it was sent."""

    radians: float
    minimum: int
    maximum: int
    target: int | None = None


class PtuAxes:
    """The `Axes` of a PTU-46, which refers itself when it is switched on."""

    def __init__(self, stage: Stage, unit: Ptu46) -> None:
        self._stage = stage
        self._unit = unit
        self._scales: dict[AxisName, _Scale] = {}

    def open(self) -> tuple[str, ...]:
        """Begin, read resolution and limits, set speeds; return what the unit is."""
        for command in ptu46.BEGIN:
            self._unit.command(command)
        facts = []
        for name in AXES:
            letter, axis = _LETTERS[name], self._axis(name)
            constants = self._unit.constants([f"{letter}{what}" for what in "rnxlu"])
            seconds_of_arc, minimum, maximum, slowest, fastest = constants.values()
            radians = ptu46.radians_per_count(seconds_of_arc)
            if not _FINEST_RAD <= radians <= _COARSEST_RAD:
                raise DeviceFault(
                    f"'{self._stage.name}' reports a resolution of {seconds_of_arc:g} seconds of arc on its "
                    f"{name} axis, where 12 to 185 are usual: check its cable, and that it is a PTU-46"
                )
            scale = _Scale(radians, int(minimum), int(maximum))
            speed = round(min(max(axis.velocity_rad_s / radians, slowest), fastest))
            self._unit.command(f"{letter}a", round(axis.acceleration_rad_s2 / radians))
            self._unit.command(f"{letter}s", speed)
            self._scales[name] = scale
            facts.append(
                f"{name}: PTU-46, {radians:.4e} rad a count, {scale.minimum * radians:.4f} .. "
                f"{scale.maximum * radians:.4f} rad, {speed * radians:.4f} rad/s"
            )
        return tuple(facts)

    def state(self, axis: AxisName) -> AxisState:
        """Return the present state; the unit moves as long as it is not where it was sent."""
        scale = self._scales[axis]
        counts = round(self._unit.ask(f"{_LETTERS[axis]}p"))
        moving = scale.target is not None and counts != scale.target
        return AxisState(counts * scale.radians, moving, homed=True)

    def resolution_rad(self, axis: AxisName) -> float:
        """Return the angle of a count."""
        return self._scales[axis].radians

    def home(self, axis: AxisName) -> None:
        """Go to 0."""
        self.move({axis: 0.0})

    def move(self, targets_rad: Mapping[AxisName, float]) -> None:
        """Begin to move to positions."""
        for axis, target in targets_rad.items():
            scale, limits = self._scales[axis], self._axis(axis)
            counts = round(target / scale.radians)
            low = max(scale.minimum * scale.radians, limits.minimum_rad)
            high = min(scale.maximum * scale.radians, limits.maximum_rad)
            # Half a count beyond a limit is the count at the limit.
            if not low - 0.5 * scale.radians <= target <= high + 0.5 * scale.radians:
                raise LimitExceeded(
                    f"the {axis} axis of '{self._stage.name}' does not go to {target:.4f} rad: its range is "
                    f"{low:.4f} .. {high:.4f} rad"
                )
            counts = min(max(counts, scale.minimum), scale.maximum)
            self._unit.command(f"{_LETTERS[axis]}p", counts)
            scale.target = counts

    def stop(self) -> None:
        """Halt both axes."""
        for scale in self._scales.values():
            scale.target = None
        self._unit.command("h")

    def clear(self) -> None:
        """Forget where it was sent; the unit has no errors to clear."""
        for scale in self._scales.values():
            scale.target = None

    def close(self) -> None:
        """Let go of the wire."""
        self._unit.close()

    def _axis(self, name: AxisName) -> Axis:
        return self._stage.pan if name == "pan" else self._stage.tilt
