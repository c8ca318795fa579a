"""DLP LightCrafter 6500 projectors and others with one controller DLPC900, by USB.

The patterns of a sequence are loaded into the projector, and white beside them. It shows one of them on
command, or plays all of them by itself, and gives a pulse at its trigger output 2 when a pattern begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault, FrameLost, InvalidInput, LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs import dlpc900 as codec
from sms_jobs.instruments.codecs.dlpc900 import Command, Hardware
from sms_jobs.instruments.optical_drivers import DriverContext, ProjectorDriver
from sms_jobs.instruments.pictures import grey_levels, pattern_brightness
from sms_jobs.instruments.transports.hid_device import HidDevice
from sms_jobs.instruments.transports.transport import Transport
from sms_jobs.records.bursts import Burst, PulseTrain
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import ProjectorInstrument

_MOST_PATTERNS = codec.MOST_IMAGES * codec.PATTERNS_AN_IMAGE - 1
"""Of a sequence; the last place is that of white."""
_REPLY_TIMEOUT_S = 2.0
_MODE_TIMEOUT_S = 2.0
_POLLS_EVERY_S = 0.05


@dataclass(frozen=True)
class Dlpc900Settings(ProjectorInstrument):
    """A projector with one controller DLPC900.

    Attributes
    ----------
    device
        Its file, such as "/dev/hidraw0".
    pattern_ms
        How long a pattern that is shown on command takes to make its grey levels, again and again: the
        cameras' exposures are multiples of it.
    settle_ms
        From the command that shows a pattern until it is light.
    load_ms
        How long it takes to load a sequence, for a dry run alone.
    pulses
        Of its trigger output 2; None where that is not wired.
    """

    driver: Literal["dlpc900"]
    device: str
    pattern_ms: float = 10.0
    settle_ms: float = 50.0
    load_ms: float = 4000.0
    pulses: PulseTrain | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.0 < self.pattern_ms <= codec.LONGEST_US / 1e3 and 0.0 <= self.settle_ms <= 60e3):
            raise InvalidInput(
                f"projector {self.name} shows patterns for {self.pattern_ms} ms and settles in "
                f"{self.settle_ms} ms: above 0 to {codec.LONGEST_US / 1e3:g} and 0 to 60000 ms are possible"
            )


class Controller:
    """Asks a DLPC900, and waits for what it answers; everything that it is told may be told again."""

    def __init__(self, name: str, transport: Transport, clock: Clock) -> None:
        self._name = name
        self._transport = transport
        self._clock = clock
        self._sequence = 0

    def tell(self, command: Command, data: bytes) -> None:
        """Send a command; raise `DeviceFault` when it is refused."""
        self._asked(command, data)

    def ask(self, command: Command) -> int:
        """Return a byte that it tells of itself."""
        data = self._asked(command, None)
        if not data:
            raise DeviceFault(f"projector {self._name} answers {command.name} with nothing")
        return data[0]

    def close(self) -> None:
        """Let go of it."""
        self._transport.close()

    def _asked(self, command: Command, data: bytes | None) -> bytes:
        self._sequence = (self._sequence + 1) % 256
        self._transport.flush()
        for report in codec.reports(codec.message(command, data, self._sequence)):
            self._transport.write(report)
        deadline = self._clock.monotonic() + _REPLY_TIMEOUT_S
        while (left := deadline - self._clock.monotonic()) > 0.0:
            answer = codec.reply(self._transport.read(left))
            if answer is None or answer.sequence != self._sequence:
                continue
            if answer.failed:
                raise DeviceFault(
                    f"projector {self._name} refuses {command.name} ({command:#06x}): switch it off and on "
                    "again, and check the exposure and period of its patterns"
                )
            return answer.data
        raise LinkLost(
            f"projector {self._name} did not answer {command.name} within {_REPLY_TIMEOUT_S:g} s; check its "
            "cable and power, and resume"
        )


@dataclass
class Dlpc900Projector:
    """A projector that shows patterns which were loaded before, or plays them."""

    settings: Dlpc900Settings
    controller: Controller
    clock: Clock
    _loaded: FringeSequence | None = None
    _timing_us: tuple[int, int] = (0, 0)
    """How long patterns are lit, and then dark, as they are defined now."""
    _plays_until: float = 0.0

    def connect(self) -> None:
        """Stop what it plays and make ready for images.

        Raises
        ------
        DeviceFault
            It did not start up, or does not take images by USB.
        """
        name, tell = self.settings.name, self.controller.tell
        status = self.controller.ask(Command.HARDWARE_STATUS)
        if not status & Hardware.INITIALISED or status & Hardware.INCOMPATIBLE:
            raise DeviceFault(
                f"projector {name} did not start up (hardware status {status:#04x}): switch it off and on "
                "again, and check its firmware"
            )
        tell(Command.START_STOP, codec.STOP)
        tell(Command.MODE, codec.ON_THE_FLY)
        begun = self.clock.monotonic()
        while self.controller.ask(Command.MODE) != codec.ON_THE_FLY[0]:
            if self.clock.monotonic() > begun + _MODE_TIMEOUT_S:
                raise DeviceFault(f"projector {name} does not take images by USB: check its firmware")
            self.clock.sleep(_POLLS_EVERY_S)

    def describe(self) -> str:
        """Return what it is."""
        settings = self.settings
        words = f"DLPC900 at {settings.device}, {settings.columns} x {settings.rows} pixels"
        if settings.pulses is None:
            return words
        return f"{words}, pulses to {', '.join(settings.pulses.cameras)}"

    def load(self, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None) -> None:
        """Load the patterns of a sequence, unless they are there.

        Raises
        ------
        InvalidInput
            There are too many, or light is to be dimmed.
        """
        name, count = self.settings.name, sequence.frames_per_exposure
        if dimming is not None:
            raise InvalidInput(
                f"projector {name} is not given dimmed patterns, which take minutes to load: record with "
                "adaptive=exposures"
            )
        if count > _MOST_PATTERNS:
            raise InvalidInput(
                f"projector {name} has room for {_MOST_PATTERNS} patterns, and the sequence has {count}: use "
                "fewer densities or steps"
            )
        wanted = replace(sequence, exposures=(1.0,))
        if wanted == self._loaded:
            return
        self._loaded = None
        images = self._images(wanted)
        self._define(count + 1, self._on_command_us)
        for number in reversed(range(len(images))):
            self.controller.tell(Command.IMAGE, codec.announced(number, len(images[number])))
            for piece in codec.pieces(images[number]):
                self.controller.tell(Command.IMAGE_DATA, piece)
        self._loaded = wanted

    def show(self, number: int) -> None:
        """Show a pattern; it is on when this returns."""
        self._repeat(range(self._patterns)[number])

    def white(self) -> None:
        """Show full brightness."""
        if self._loaded is None:
            self.load(FringeSequence())
        self._repeat(self._patterns)

    def dark(self) -> None:
        """Show nothing, whatever state it is in."""
        self.controller.tell(Command.START_STOP, codec.STOP)

    def play(self, burst: Burst) -> None:
        """Begin to show every pattern once, lit as long as the cameras expose."""
        lit_us, period_us = round(1e6 * burst.lit_s), round(1e6 * burst.period_s)
        self._time((lit_us, period_us - lit_us))
        self.controller.tell(Command.ORDER, codec.order(range(self._patterns), repeated=False))
        self.controller.tell(Command.START_STOP, codec.START)
        self._plays_until = self.clock.monotonic() + burst.seconds

    def wait(self) -> None:
        """Return when it has played to the end; what was not seen of it the cameras tell."""
        self.clock.sleep(self._plays_until - self.clock.monotonic())
        status = self.controller.ask(Command.HARDWARE_STATUS)
        if status & (Hardware.ABORTED | Hardware.SEQUENCER_ERROR):
            raise FrameLost(
                f"projector {self.settings.name} stopped in the middle of its patterns (hardware status "
                f"{status:#04x})"
            )

    @property
    def _patterns(self) -> int:
        return 0 if self._loaded is None else self._loaded.frames_per_exposure

    @property
    def _on_command_us(self) -> tuple[int, int]:
        return round(1e3 * self.settings.pattern_ms), 0

    def _repeat(self, index: int) -> None:
        self._time(self._on_command_us)
        self.controller.tell(Command.ORDER, codec.order([index], repeated=True))
        self.controller.tell(Command.START_STOP, codec.START)
        self.clock.sleep(self.settings.settle_ms / 1e3)

    def _time(self, timing_us: tuple[int, int]) -> None:
        """Stop, and have patterns lit and dark for so long from now on."""
        self.dark()
        if timing_us != self._timing_us:
            self._define(self._patterns + 1, timing_us)

    def _define(self, count: int, timing_us: tuple[int, int]) -> None:
        self._timing_us = (0, 0)
        self.dark()
        for index in range(count):
            self.controller.tell(Command.PATTERN, codec.definition(codec.grey_pattern(index, *timing_us)))
        self.controller.tell(Command.PATTERNS, codec.patterns(count))
        self._timing_us = timing_us

    def _images(self, sequence: FringeSequence) -> list[bytes]:
        """Return the images that hold the patterns of a sequence, and white after them."""
        each = codec.PATTERNS_AN_IMAGE
        return [
            codec.image(np.stack([self._levels(sequence, k + place) for place in range(each)]))
            for k in range(0, sequence.frames_per_exposure + 1, each)
        ]

    def _levels(self, sequence: FringeSequence, number: int) -> NDArray[np.uint8]:
        columns, rows = self.settings.columns, self.settings.rows
        brightness = np.ones((1, 1))
        if number < sequence.frames_per_exposure:
            brightness = pattern_brightness(sequence, number, columns, rows)
        return np.broadcast_to(grey_levels(brightness, 1.0), (rows, columns))


def connect(projector: Dlpc900Settings, context: DriverContext) -> Dlpc900Projector:
    """Open a projector.

    Raises
    ------
    LinkLost
        When there is no such file, or nobody answers there.
    DeviceFault
        When it did not start up.
    """
    controller = Controller(projector.name, HidDevice(projector.name, projector.device), context.clock)
    context.ending.callback(controller.close)
    opened = Dlpc900Projector(projector, controller, context.clock)
    opened.connect()
    return opened


DRIVER = ProjectorDriver("dlpc900", Dlpc900Settings, connect)
