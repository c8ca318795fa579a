"""The cameras and projectors of a rig, and the whole of a rig file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

from sms_jobs.errors import InvalidInput
from sms_jobs.records.bursts import Burst, PulseTrain
from sms_jobs.records.instruments import Instruments, Stage
from sms_jobs.records.subject import checked_name

SIMULATED = "simulated"
"""Name of the drivers of what is made of light rays."""
MOST_PIXELS = 65535


@dataclass(frozen=True)
class OpticalFault:
    """What a simulated camera is to do wrong.

    Attributes
    ----------
    fault
        "dropped-frame": a frame is triggered and never arrives. "flash": a lamp shines into the camera while
        a set is recorded. "unplugged": nothing is heard of the camera any more. Of a pulse of a projector
        alone: "lost-pulse" does not come, "double-pulse" exposes twice, "late-pulse" comes late.
    state
        Label of the load state at which it happens; empty for every state.
    frame
        Count of the camera's triggers at that state, from 1, at which it happens; pulses are triggers.
    """

    fault: Literal["dropped-frame", "flash", "unplugged", "lost-pulse", "double-pulse", "late-pulse"]
    state: str = ""
    frame: int = 1


@dataclass(frozen=True)
class ProjectorFault:
    """What a simulated projector is to do wrong.

    Attributes
    ----------
    fault
        "stops": it stops in the middle of what it plays by itself.
    state
        Label of the load state at which it happens; empty for every state.
    frame
        Count of the patterns that it plays at that state, from 1, before which it happens.
    """

    fault: Literal["stops"]
    state: str = ""
    frame: int = 1


@dataclass(frozen=True)
class OpticalInstrument:
    """A camera or projector and how it is reached; each driver has a record of its own for what it must know.

    Attributes
    ----------
    name
        C1, C2, ... or P1, P2, ...
    columns, rows
        Of its image, in pixels.
    driver
        Of which make it is.
    """

    name: str
    columns: int
    rows: int
    driver: str

    def __post_init__(self) -> None:
        _check_size(self.name, self.columns, self.rows)


class ImageFormat(Protocol):
    """A sensor by its name and the size of its image in px."""

    @property
    def name(self) -> str:
        """Return its name."""

    @property
    def columns(self) -> int:
        """Return how many columns its image has."""

    @property
    def rows(self) -> int:
        """Return how many rows its image has."""


@dataclass(frozen=True)
class CameraInstrument(OpticalInstrument):
    """A camera and how it is reached."""

    @property
    def wired(self) -> bool:
        """Whether it is exposed through a wire from a trigger controller."""
        return False

    @property
    def exposure_s(self) -> float:
        """How long an exposure of 1 takes, in s; 0 where its file does not say it, in `exposure_ms`."""
        return float(getattr(self, "exposure_ms", 0.0)) / 1e3

    @property
    def pulsed(self) -> bool:
        """Whether a projector's pulses can expose it."""
        return False

    def busy_s(self, exposure: float) -> float:
        """Return how long it is from one pulse until it is ready for the next, as far as its file says."""
        return exposure * self.exposure_s + float(getattr(self, "readout_ms", 0.0)) / 1e3


@dataclass(frozen=True)
class ProjectorInstrument(OpticalInstrument):
    """A projector and how it is reached."""

    @property
    def settle_s(self) -> float:
        """How long a picture takes to be on, in s; 0 where its file does not say it, in `settle_ms`."""
        return float(getattr(self, "settle_ms", 0.0)) / 1e3

    @property
    def load_s(self) -> float:
        """How long it takes to be given the patterns of a sequence, in s; its file says so in `load_ms`."""
        return float(getattr(self, "load_ms", 0.0)) / 1e3

    @property
    def pulse_train(self) -> PulseTrain | None:
        """Its pulses, where it plays patterns by itself and its file says whom they expose, in `pulses`."""
        found: PulseTrain | None = getattr(self, "pulses", None)
        return found


@dataclass(frozen=True)
class VirtualCamera(CameraInstrument):
    """A camera that looks at the virtual rig.

    Attributes
    ----------
    faults
        What it is to do wrong.
    """

    driver: Literal["simulated"]
    faults: tuple[OpticalFault, ...] = ()

    @property
    def pulsed(self) -> bool:
        """Whether a projector's pulses can expose it."""
        return True


@dataclass(frozen=True)
class VirtualProjector(ProjectorInstrument):
    """A projector that lights the virtual rig.

    Attributes
    ----------
    settle_ms
        Between handing over a picture and light: the display's and the projector's delay.
    pulses
        With which it plays patterns by itself; None where each is shown by a command.
    faults
        What it is to do wrong.
    """

    driver: Literal["simulated"]
    settle_ms: float = 50.0
    pulses: PulseTrain | None = None
    faults: tuple[ProjectorFault, ...] = ()


def _wiring_at_odds(rig: str, camera: CameraInstrument) -> str:
    if camera.wired:
        return (
            f"{camera.name} of rig {rig} waits for a trigger by wire, but no trigger controller is wired to "
            "it; describe one under [[triggers]]"
        )
    return (
        f"a trigger controller of rig {rig} is wired to {camera.name}, which does not wait for it: name the "
        'camera\'s line, such as trigger = "Line1", where its driver knows lines'
    )


def _check_pulses(rig: str, train: PulseTrain, projector: str, cameras: dict[str, CameraInstrument]) -> None:
    """Raise `InvalidInput` where pulses are wired to what they cannot expose as one."""
    for name in train.cameras:
        if name not in cameras:
            raise InvalidInput(
                f"rig {rig} wires pulses of {projector} to {name}, which is none of its cameras "
                f"{', '.join(cameras)}"
            )
        if not cameras[name].pulsed:
            raise InvalidInput(
                f"rig {rig} wires pulses of {projector} to {name}, which does not wait for them: name its "
                'line, such as pulse_line = "Line2", where its driver knows lines'
            )
    exposed = {name: cameras[name].exposure_s for name in train.cameras}
    real = any(cameras[name].driver != SIMULATED for name in train.cameras)
    if len(set(exposed.values())) > 1 or (real and not all(exposed.values())):
        each = " and ".join(f"{name} for {1e3 * seconds:g} ms" for name, seconds in exposed.items())
        raise InvalidInput(
            f"in rig {rig} pulses of {projector} expose {each}: give all of these one exposure_ms, for which "
            "every pattern is lit"
        )


def _check_size(name: str, columns: int, rows: int) -> None:
    if not (1 <= columns <= MOST_PIXELS and 1 <= rows <= MOST_PIXELS):
        raise InvalidInput(
            f"the image of {name} has {columns} columns and {rows} rows: from 1 to {MOST_PIXELS} of each "
            "are possible"
        )


@dataclass(frozen=True)
class RigFile:
    """All instruments of a rig, as its file on the host that they are connected to describes them.

    Attributes
    ----------
    name
        Of the rig, as campaigns name it.
    cameras, projectors
        Its sensors.
    serial
        Stages, trigger controllers, video splitters and scalar channels.
    """

    name: str
    cameras: tuple[CameraInstrument, ...]
    projectors: tuple[ProjectorInstrument, ...]
    serial: Instruments = field(default_factory=Instruments)

    def __post_init__(self) -> None:
        checked_name(self.name, "rig")
        names = self.sensors
        if len(set(names)) < len(names):
            raise InvalidInput(f"rig {self.name} has two sensors of one name: {', '.join(names)}")
        triggered = [w.sensor for box in self.serial.triggers for w in box.wiring]
        fed = [w.sensor for box in self.serial.splitters for w in box.wiring]
        for sensor in (*triggered, *fed):
            if sensor not in names:
                raise InvalidInput(
                    f"rig {self.name} wires {sensor}, which it does not have; it has {', '.join(names)}"
                )
        if len({driver == SIMULATED for driver in self._drivers}) == 2:
            raise InvalidInput(
                f"rig {self.name} has simulated sensors beside real ones: real cameras do not see simulated "
                "light; describe two rigs"
            )
        for camera in self.cameras:
            if camera.driver != SIMULATED and camera.wired != (camera.name in triggered):
                raise InvalidInput(_wiring_at_odds(self.name, camera))
        by_name = {c.name: c for c in self.cameras}
        for projector in self.projectors:
            if projector.pulse_train is not None:
                _check_pulses(self.name, projector.pulse_train, projector.name, by_name)

    def way(self, projector: str, cameras: Collection[str], exposures: Sequence[float]) -> str:
        """Return in words how a projector's patterns come before some cameras, and if one by one, why."""
        train = self._pulse_train(projector)
        if train is None:
            return f"patterns shown one by one: the file of rig {self.name} gives {projector} no pulses"
        if missing := train.missing(cameras):
            return f"patterns shown one by one: its pulses do not reach {', '.join(missing)}"
        bursts = [self.burst(projector, cameras, 1, exposure) for exposure in exposures]
        periods = dict.fromkeys(f"{1e3 * burst.period_s:g}" for burst in bursts if burst is not None)
        return f"patterns played in a burst, one every {', '.join(periods)} ms"

    def burst(self, projector: str, cameras: Collection[str], frames: int, exposure: float) -> Burst | None:
        """Return how a projector plays so many patterns to some cameras; None where it does not.

        It waits for the camera that needs longest.
        """
        train = self._pulse_train(projector)
        if train is None or train.missing(cameras):
            return None
        seeing = [c for c in self.cameras if c.name in cameras]
        period_s = max(train.period_ms / 1e3, *(c.busy_s(exposure) for c in seeing))
        lit_s = max(c.exposure_s for c in seeing) * exposure
        return Burst(frames, exposure, period_s, train.lead_ms / 1e3, lit_s)

    def _pulse_train(self, projector: str) -> PulseTrain | None:
        return next((p.pulse_train for p in self.projectors if p.name == projector), None)

    def lacking(self, sensors: Iterable[str], planned: Iterable[ImageFormat]) -> list[str]:
        """Say which of some sensors it has not, and which have another image than is planned."""
        sizes = {one.name: (one.columns, one.rows) for one in (*self.cameras, *self.projectors)}
        expected = {one.name: (one.columns, one.rows) for one in planned}
        names = dict.fromkeys(sensors)
        there = ", ".join(sizes) or "none"
        missing = [
            f"the file of rig {self.name} has no {name}; it has {there}"
            for name in names
            if name not in sizes
        ]
        differing = [
            f"{name} has {sizes[name][0]} x {sizes[name][1]} px in the file of rig {self.name}, and "
            f"{expected[name][0]} x {expected[name][1]} px in the plan: correct one of them"
            for name in names
            if name in sizes and sizes[name] != expected.get(name, sizes[name])
        ]
        return [*missing, *differing]

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of its cameras, then of its projectors."""
        return (*(c.name for c in self.cameras), *(p.name for p in self.projectors))

    @property
    def simulated(self) -> bool:
        """Whether its sensors are made of light rays."""
        return SIMULATED in self._drivers

    @property
    def _drivers(self) -> tuple[str, ...]:
        return (*(c.driver for c in self.cameras), *(p.driver for p in self.projectors))

    @property
    def stage(self) -> Stage | None:
        """The first stage, which carries calibration artefacts."""
        return self.serial.stages[0] if self.serial.stages else None

    @property
    def devices(self) -> tuple[str, ...]:
        """Names of all instruments, sorted: what a recording locks."""
        return tuple(sorted([*self.sensors, *(d.name for d in self.serial.serial)]))
