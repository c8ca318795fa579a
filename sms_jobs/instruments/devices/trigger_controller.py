"""A trigger controller: which output is wired to which camera, strobe or projector."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from sms_jobs.errors import InvalidInput, LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.devices.device import Description, Status, at_once
from sms_jobs.instruments.drivers.line_device import LineDevice
from sms_jobs.instruments.operation_log import OperationLog
from sms_jobs.instruments.protocols import Fired
from sms_jobs.records.instruments import TriggerController, VideoSplitter
from sms_jobs.records.operations import Reading

_SILENT_TRIGGERS = 3
_logger = logging.getLogger(__name__)


class TriggerBox:
    """A device that triggers what is wired to its outputs."""

    def __init__(
        self, settings: TriggerController, line: LineDevice, clock: Clock, log: OperationLog | None = None
    ) -> None:
        self._settings = settings
        self._line = line
        self._clock = clock
        self._log = log or OperationLog(clock)
        self._selected: tuple[int, ...] = ()
        self._fired: dict[int, Fired] = {}
        self._unconfirmed = 0

    @property
    def name(self) -> str:
        """Its name in the rig."""
        return self._settings.name

    def connect(self) -> None:
        """Send what configures it."""
        with self._log.operation(self.name, "connect"):
            for request in self._settings.configure:
                self._line.request(request)

    def close(self) -> None:
        """Let go of it."""
        self._line.close()

    def describe(self) -> Description:
        """Return its wiring."""
        wires = tuple(f"output {wire.output}: {wire.sensor}" for wire in self._settings.wiring)
        return Description(self.name, "trigger controller", wires, ())

    def read(self) -> tuple[Reading, ...]:
        """Return nothing: it measures nothing."""
        return ()

    def set(self, value: Iterable[str]) -> Status:
        """Select the outputs that lead to sensors.

        Raises
        ------
        InvalidInput
            A sensor is not wired to this controller.
        """
        outputs = outputs_of(self._settings, value)

        def select() -> None:
            for output in outputs:
                if self._settings.select:
                    self._line.request(self._settings.select.format(output=output))
            self._selected = outputs

        return at_once(f"'{self.name}' to select {outputs}", select, self._clock)

    def trigger(self) -> Status:
        """Trigger the outputs that are selected, or all that are wired.

        A trigger is never repeated, since a camera would expose twice. Where its reply is lost, the frames
        say whether it came: a camera that was not triggered delivers none. Only a box that falls silent for
        several triggers in a row raises `LinkLost`.
        """
        every = tuple(sorted({wire.output for wire in self._settings.wiring}))
        outputs = self._selected or every

        def fire() -> None:
            with self._log.operation(self.name, "trigger", ", ".join(map(str, outputs))):
                # A request that names no output triggers whatever is selected, once.
                requests = {output: self._settings.trigger.format(output=output) for output in outputs}
                sent = {request: self._send_once(request) for request in dict.fromkeys(requests.values())}
                self._fired = {output: sent[request] for output, request in requests.items()}

        return at_once(f"'{self.name}' to trigger", fire, self._clock)

    def _send_once(self, request: str) -> Fired:
        """Send a request and return between which moments the box did what it says."""
        begun = self._clock.monotonic()
        try:
            self._line.request(request, retries=0)
        except LinkLost:
            self._unconfirmed += 1
            if self._unconfirmed >= _SILENT_TRIGGERS:
                raise
            _logger.warning(
                "'%s' did not confirm %r: the frames will tell whether it fired", self.name, request
            )
        else:
            self._unconfirmed = 0
        return Fired(begun, self._clock.monotonic())

    def fire(self, cameras: Iterable[str]) -> dict[str, Fired]:
        """Expose cameras together, by their names, and return when each was."""
        names = tuple(cameras)
        self.set(names).wait()
        self.trigger().wait()
        wiring = {wire.sensor: wire.output for wire in self._settings.wiring}
        return {name: self._fired[wiring[name]] for name in names}


class VideoSwitch:
    """A device that feeds the video signal to one projector at a time."""

    def __init__(
        self, settings: VideoSplitter, line: LineDevice, clock: Clock, log: OperationLog | None = None
    ) -> None:
        self._settings = settings
        self._line = line
        self._clock = clock
        self._log = log or OperationLog(clock)

    @property
    def name(self) -> str:
        """Its name in the rig."""
        return self._settings.name

    def connect(self) -> None:
        """Switch to the first projector, which shows whether the device answers."""
        with self._log.operation(self.name, "connect"):
            self._select(self._settings.wiring[0].output)

    def close(self) -> None:
        """Let go of it."""
        self._line.close()

    def describe(self) -> Description:
        """Return its wiring."""
        wires = tuple(f"output {wire.output}: {wire.sensor}" for wire in self._settings.wiring)
        return Description(self.name, "video splitter", wires, ())

    def read(self) -> tuple[Reading, ...]:
        """Return nothing: it measures nothing."""
        return ()

    def set(self, value: str) -> Status:
        """Feed a projector; done when it had time to show the picture.

        Raises
        ------
        InvalidInput
            The projector is not wired to this splitter.
        """
        [output] = outputs_of(self._settings, [value])
        return at_once(
            f"'{self.name}' to switch to {value}",
            lambda: self._select(output),
            self._clock,
            self._settings.settle_s,
        )

    def _select(self, output: int) -> None:
        with self._log.operation(self.name, "select", str(output)):
            self._line.request(self._settings.select.format(output=output))


def outputs_of(settings: TriggerController | VideoSplitter, sensors: Iterable[str]) -> tuple[int, ...]:
    """Return the outputs that lead to sensors, each once; raise `InvalidInput` for one that is not wired."""
    wiring = {wire.sensor: wire.output for wire in settings.wiring}
    outputs = set()
    for sensor in sensors:
        if sensor not in wiring:
            raise InvalidInput(
                f"{sensor} is not wired to '{settings.name}', which has {', '.join(wiring)}: add it to the "
                "wiring in the rig file"
            )
        outputs.add(wiring[sensor])
    return tuple(sorted(outputs))
