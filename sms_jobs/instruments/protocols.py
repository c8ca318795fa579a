"""What the rest of the program asks of instruments, whichever make they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.devices.device import Status
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.records.bursts import Burst
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.operations import Reading
from sms_jobs.records.units import in_unit_of_name


class Recorder(Protocol):
    """Cameras and projectors that record together."""

    def record(
        self, view: str, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None
    ) -> Measurement:
        """Project a sequence with the view's projector and record it with its camera.

        `dimming`, the size of the projector's image, is what every pattern is multiplied by, white too.
        The frames may be taken while they are asked for. Raises `InvalidInput` for a view that the rig
        does not have.
        """
        ...


@dataclass(frozen=True)
class Fired:
    """When a camera began to expose, as well as that is known, by the clock of the rig.

    Attributes
    ----------
    not_before_s, not_after_s
        Cameras that one wire exposes have the same.
    """

    not_before_s: float
    not_after_s: float


def apart_s(fired: Iterable[Fired]) -> float:
    """Return how far apart, at most, cameras may have started to expose; 0 if one signal exposed them all."""
    known = set(fired)
    if len(known) < 2:
        return 0.0
    return max(f.not_after_s for f in known) - min(f.not_before_s for f in known)


@dataclass(frozen=True)
class Frame:
    """One image as a camera delivered it.

    Attributes
    ----------
    number
        The camera's own count of its frames: a gap is a frame that was lost on the way.
    time_s
        When it was exposed, by the clock of the rig.
    image
        (rows, columns), uint8 or uint16.
    fired
        When it was, of a camera that does not wait for its trigger, or is triggered by another computer; None
        where whoever triggered it here knows.
    """

    number: int
    time_s: float
    image: NDArray[Any]
    fired: Fired | None = None


@dataclass(frozen=True)
class CameraFacts:
    """What does not change about a camera.

    Attributes
    ----------
    columns, rows
        Of its image, in pixels.
    dtype
        "uint8" or "uint16".
    full_scale
        Grey level at which it saturates.
    gain, read_noise
        Noise model in grey levels, see `Measurement`.
    """

    columns: int
    rows: int
    dtype: str
    full_scale: int
    gain: float
    read_noise: float


class Camera(Protocol):
    """A camera that takes one frame for each trigger."""

    @property
    def facts(self) -> CameraFacts:
        """What does not change about it."""
        ...

    def arm(self, exposure: float) -> None:
        """Make ready to be triggered, with an exposure in units of the camera's own."""
        ...

    def trigger(self) -> None:
        """Take a frame; a camera that a trigger controller exposes by wire makes ready for that alone."""
        ...

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest frame that was not read; raise `FrameLost` or `LinkLost` when none comes."""
        ...

    def disarm(self) -> None:
        """Stop taking frames, whatever state it is in."""
        ...


@runtime_checkable
class BurstCamera(Camera, Protocol):
    """A camera that a projector's pulses expose by wire; `read` gives its frames, `disarm` ends it."""

    def arm_burst(self, burst: Burst) -> None:
        """Make ready to be exposed by every pulse that comes, and to keep a frame for each.

        Raises `DeviceFault` when the camera cannot expose so long.
        """
        ...

    def left_over(self, timeout_s: float) -> int:
        """Return how many frames were not read, and forget them; wait for one where there is none."""
        ...


class Projector(Protocol):
    """A projector that shows one pattern after the other."""

    def load(self, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None) -> None:
        """Make ready for the patterns of a sequence, each of which `dimming`, (rows, columns), multiplies.

        White is dimmed, too. Raises `InvalidInput` where it cannot be dimmed.
        """
        ...

    def show(self, number: int) -> None:
        """Show a pattern, counted from 0 as in `sequence.patterns()`; it is on when this returns."""
        ...

    def white(self) -> None:
        """Show full brightness; it is on when this returns."""
        ...

    def dark(self) -> None:
        """Show nothing, whatever state it is in."""
        ...


@runtime_checkable
class SequencedProjector(Projector, Protocol):
    """A projector that plays the patterns of its sequence by itself; `dark` stops it."""

    def play(self, burst: Burst) -> None:
        """Begin to show every pattern of the sequence once, with a pulse at the beginning of each."""
        ...

    def wait(self) -> None:
        """Return when it has played to the end; raise `FrameLost` when it stopped before."""
        ...


class Channel(Protocol):
    """A load cell or any other source of one number."""

    @property
    def unit(self) -> str:
        """Unit of its values."""
        ...

    def read(self) -> float:
        """Return the present value; raise `LinkLost` when none comes."""
        ...

    def reading(self) -> Reading:
        """Return the same with the time of day at which it was so."""
        ...


def recorded_value(name: str, channel: Channel, value: float) -> float:
    """Return what a channel read in the unit of its name, in which every recording keeps it: load_n in N."""
    return in_unit_of_name(name, value, channel.unit)


class Stage(Protocol):
    """A pan-tilt stage."""

    def stage(self) -> None:
        """Make ready for poses: look for home where an axis does not know it."""
        ...

    def set(self, value: StagePose) -> Status:
        """Begin to go to a pose; raise `LimitExceeded` where it must not go."""
        ...

    def angles(self) -> tuple[float, float]:
        """Return pan and tilt as the stage reads them, in rad."""
        ...

    def known_angles(self) -> tuple[float, float] | None:
        """Return the same; None when it has not been home, so that its angles mean nothing."""
        ...

    def home(self) -> None:
        """Go home the way it came, so that the cable uncoils."""
        ...

    def stop(self) -> None:
        """Stand still at once."""
        ...


class Trigger(Protocol):
    """What makes the cameras of a rig expose together."""

    def fire(self, cameras: Mapping[str, Camera]) -> Mapping[str, Fired]:
        """Expose all of them, and return by name when that was."""
        ...


@dataclass(frozen=True)
class SoftwareTrigger:
    """Triggers the cameras one right after the other over their own links."""

    clock: Clock

    def fire(self, cameras: Mapping[str, Camera]) -> dict[str, Fired]:
        """Expose all of them."""
        fired = {}
        for name, camera in cameras.items():
            begun = self.clock.monotonic()
            camera.trigger()
            fired[name] = Fired(begun, self.clock.monotonic())
        return fired


class Lamp(Protocol):
    """What lights a specimen whose texture is recorded without a projector."""

    def on(self) -> None:
        """Light it; the light is there when this returns."""
        ...

    def off(self) -> None:
        """Light it no more, whatever state it is in."""
        ...


class StandingLamp:
    """A lamp that nobody switches from here: it shines, or somebody has forgotten it."""

    def on(self) -> None:
        """Do nothing: it shines."""

    def off(self) -> None:
        """Do nothing."""


class Video(Protocol):
    """What brings the picture to one of several projectors."""

    def feed(self, projector: str) -> None:
        """Feed a projector; it has the picture when this returns."""
        ...


class DirectVideo:
    """Every projector has a picture of its own."""

    def feed(self, projector: str) -> None:
        """Do nothing: the picture is there."""
