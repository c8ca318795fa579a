"""Simulated cameras and projectors in one room: what a projector shows is what the cameras see."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import FrameLost, LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.protocols import CameraFacts, Frame
from sms_jobs.records.bursts import Burst, PulseTrain
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import OpticalFault, ProjectorFault
from sms_jobs.records.scene import Deformation, PanTilt, Scene, Simulation
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.noise import Noise
from sms_jobs.virtual_rig.rendering import Rendering, render

WHITE = -1
"""In place of a pattern's number: full brightness."""
LAMP = ""
"""In place of a projector's name: what lights cameras whose images are recorded without one."""
_FLASH = 2.0
"""What a lamp adds, in units of full scale: nothing else is left to be seen."""


@dataclass(frozen=True)
class Setting:
    """What stands before the instruments of a virtual rig.

    Attributes
    ----------
    scene
        The sensors as they truly are, and the specimen or the artefact.
    state, deformation
        Label of the load state, and what it does to the specimen.
    channels
        What simulated channels read there, by name.
    """

    scene: Scene
    state: str
    deformation: tuple[Deformation, ...]
    channels: Mapping[str, float] = field(default_factory=dict)


@dataclass
class VirtualRoom:
    """The room in which the instruments of a virtual rig stand.

    Attributes
    ----------
    setting
        What stands there.
    clock
        The time in the room.
    stage_angles
        Where the stage that carries the artefact truly is, in rad; without one the angles of the deformation
        hold.
    threads
        For rendering.
    wires
        What is done with a pulse, by the names of the cameras that wait for one: given its time, in s, and
        that to the next one.
    """

    setting: Setting
    clock: Clock
    stage_angles: Callable[[], tuple[float, float]] | None = None
    threads: int = 1
    wires: dict[str, Callable[[float, float], None]] = field(default_factory=dict)
    _lit: tuple[str, FringeSequence, int, NDArray[np.float32] | None] | None = None
    _seen: dict[tuple[object, ...], Rendering] = field(default_factory=dict)

    def light(
        self,
        projector: str,
        sequence: FringeSequence,
        number: int,
        dimming: NDArray[np.float32] | None = None,
    ) -> None:
        """Have a projector show a pattern, or white; or have the lamp shine."""
        self._lit = projector, sequence, number, dimming

    def darken(self, projector: str) -> None:
        """Have a projector, or the lamp, show nothing."""
        if self._lit is not None and self._lit[0] == projector:
            self._lit = None

    def view(self, camera: str, exposure: float) -> NDArray[Any]:
        """Return what a camera sees now."""
        return self.exposed(camera, exposure)()

    def exposed(self, camera: str, exposure: float) -> Callable[[], NDArray[Any]]:
        """Return what computes the image of what a camera sees now, whenever it is asked for."""
        return partial(self._image, camera, exposure, self._lit, self.present_deformation())

    def simulation(self, view: str) -> Simulation:
        """Return what a view truly sees now."""
        return self._simulation(view, self.present_deformation())

    def _simulation(self, view: str, deformation: tuple[Deformation, ...]) -> Simulation:
        return Simulation.of(self.setting.scene, view_of(view), deformation, self.setting.state)

    def _image(
        self,
        camera: str,
        exposure: float,
        lit: tuple[str, FringeSequence, int, NDArray[np.float32] | None] | None,
        deformation: tuple[Deformation, ...],
    ) -> NDArray[Any]:
        if lit is None:
            rows, columns = self._size(camera)
            return np.zeros((rows, columns), np.uint16)
        projector, sequence, number, dimming = lit
        rendering = self._rendering(camera, projector, sequence, dimming, deformation)
        if number == WHITE:
            return rendering.frames.texture(exposure)
        place = sequence.exposures.index(exposure) * sequence.frames_per_exposure + number
        return rendering.frames.frame(place)

    def _size(self, camera: str) -> tuple[int, int]:
        sensor = self.setting.scene.rig.sensor(camera)
        return sensor.rows, sensor.columns

    def _rendering(
        self,
        camera: str,
        projector: str,
        sequence: FringeSequence,
        dimming: NDArray[np.float32] | None,
        deformation: tuple[Deformation, ...],
    ) -> Rendering:
        """Return the frames of a view; what was seen from one place is kept while nothing moves."""
        key = (camera, projector, sequence, None if dimming is None else dimming.tobytes(), deformation)
        if key not in self._seen:
            # Those of another projector or pose will not be asked for again.
            self._seen = {k: v for k, v in self._seen.items() if k[1:] == key[1:]}
            simulation = self._simulation(camera + projector, deformation)
            self._seen[key] = render(simulation, sequence, threads=self.threads, dimming=dimming)
        return self._seen[key]

    def present_deformation(self) -> tuple[Deformation, ...]:
        """Return how what stands there stands now."""
        if self.stage_angles is None:
            return self.setting.deformation
        stage = PanTilt(*self.stage_angles())
        return tuple(stage if isinstance(d, PanTilt) else d for d in self.setting.deformation)


@dataclass
class SimulatedProjector:
    """A projector of the virtual rig."""

    name: str
    room: VirtualRoom
    settle_s: float = 0.0
    pulses: PulseTrain | None = None
    faults: tuple[ProjectorFault, ...] = ()
    _sequence: FringeSequence = field(default_factory=FringeSequence)
    _dimming: NDArray[np.float32] | None = None
    _played: int = 0
    _plays_until: float = 0.0
    _stopped: str = ""

    def describe(self) -> str:
        """Return what it is."""
        return "simulated: lights the scene of the virtual rig"

    def load(self, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None) -> None:
        """Make ready for the patterns of a sequence."""
        self._sequence, self._dimming = sequence, dimming

    def show(self, number: int) -> None:
        """Show a pattern; it is on when this returns."""
        pattern = range(self._sequence.frames_per_exposure)[number]
        self.room.light(self.name, self._sequence, pattern, self._dimming)
        self.room.clock.sleep(self.settle_s)

    def white(self) -> None:
        """Show full brightness."""
        self.room.light(self.name, self._sequence, WHITE, self._dimming)
        self.room.clock.sleep(self.settle_s)

    def play(self, burst: Burst) -> None:
        """Begin to show every pattern once; all of them are told to the cameras at once, with their times."""
        begun = self.room.clock.monotonic() + burst.lead_s
        self._plays_until, self._stopped = begun + burst.frames * burst.period_s, ""
        for pattern in range(burst.frames):
            self._played += 1
            if any(f.frame == self._played for f in self._here()):
                self._stopped = f"projector {self.name} stopped after {pattern} of {burst.frames} patterns"
                break
            self.room.light(self.name, self._sequence, pattern, self._dimming)
            for camera in self.pulses.cameras if self.pulses is not None else ():
                if camera in self.room.wires:
                    self.room.wires[camera](begun + pattern * burst.period_s, burst.period_s)
        self.room.darken(self.name)

    def wait(self) -> None:
        """Return when it has played to the end."""
        self.room.clock.sleep(self._plays_until - self.room.clock.monotonic())
        if self._stopped:
            raise FrameLost(self._stopped)

    def dark(self) -> None:
        """Show nothing."""
        self.room.darken(self.name)

    def _here(self) -> list[ProjectorFault]:
        return [f for f in self.faults if f.state in ("", self.room.setting.state)]


@dataclass(frozen=True)
class _Exposed:
    """A frame that was exposed; light takes long to compute, and a trigger no time."""

    number: int
    time_s: float
    image: Callable[[], NDArray[Any]]
    flash: bool


@dataclass
class SimulatedCamera:
    """A camera of the virtual rig, with faults on demand."""

    name: str
    room: VirtualRoom
    faults: tuple[OpticalFault, ...] = ()
    _exposure: float | None = None
    _triggers: int = 0
    _number: int = 0
    _waiting: list[_Exposed] = field(default_factory=list)
    _flashes: int = 0

    @property
    def facts(self) -> CameraFacts:
        """What does not change about it."""
        sensor, noise = (
            self.room.setting.scene.rig.sensor(self.name),
            Noise.of(self.room.setting.scene.camera),
        )
        read_noise = (noise.read_noise**2 + 1.0 / 12.0) ** 0.5  # with the rounding to whole grey levels
        return CameraFacts(sensor.columns, sensor.rows, "uint16", noise.full_scale, noise.gain, read_noise)

    def describe(self) -> str:
        """Return what it is."""
        return "simulated: looks at the scene of the virtual rig"

    def arm(self, exposure: float) -> None:
        """Make ready to be triggered."""
        self._plugged_in()
        self._exposure = exposure
        self._waiting.clear()
        self.room.wires.pop(self.name, None)

    def arm_burst(self, burst: Burst) -> None:
        """Make ready to be exposed by pulses."""
        self.arm(burst.exposure)
        self.room.wires[self.name] = self._pulse

    def left_over(self, timeout_s: float) -> int:
        """Return how many frames were not read, and forget them."""
        left = len(self._waiting)
        if not left:
            self.room.clock.sleep(timeout_s)
        self._waiting.clear()
        return left

    def trigger(self) -> None:
        """Take a frame; a camera that is not armed takes none."""
        self._triggers += 1
        self._expose(self.room.clock.monotonic())

    def _pulse(self, time_s: float, period_s: float) -> None:
        """Take a frame when a pulse comes."""
        self._triggers += 1
        if self._now("lost-pulse"):
            return
        self._expose(time_s + 0.3 * period_s * self._now("late-pulse"))
        if self._now("double-pulse"):
            self._expose(time_s + 0.5 * period_s)

    def _expose(self, time_s: float) -> None:
        if self._exposure is None or self._has("unplugged"):
            return
        self._number += 1
        if self._now("dropped-frame"):
            return
        image = self.room.exposed(self.name, self._exposure)
        if self._now("flash"):
            self._flashes = 3
        flash = self._flashes > 0
        self._flashes -= flash
        self._waiting.append(_Exposed(self._number, time_s, image, flash))

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest frame that was not read."""
        self._plugged_in()
        if not self._waiting:
            self.room.clock.sleep(timeout_s)
            raise FrameLost(f"camera {self.name} delivered no frame within {timeout_s:g} s of its trigger")
        exposed = self._waiting.pop(0)
        self.room.clock.sleep(exposed.time_s - self.room.clock.monotonic())
        image = exposed.image()
        if exposed.flash:
            noise = Noise.of(self.room.setting.scene.camera)
            image = np.minimum(image + _FLASH * noise.full_scale, noise.full_scale).astype(np.uint16)
        return Frame(exposed.number, exposed.time_s, image)

    def disarm(self) -> None:
        """Stop taking frames."""
        self._exposure = None
        self.room.wires.pop(self.name, None)

    def _now(self, fault: str) -> bool:
        return any(f.frame == self._triggers for f in self._here(fault))

    def _here(self, fault: str) -> list[OpticalFault]:
        return [f for f in self.faults if f.fault == fault and f.state in ("", self.room.setting.state)]

    def _has(self, fault: str) -> bool:
        return any(self._triggers >= f.frame for f in self._here(fault))

    def _plugged_in(self) -> None:
        if self._has("unplugged"):
            raise LinkLost(f"camera {self.name} does not answer; check its cable and its power")
