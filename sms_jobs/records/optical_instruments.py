"""The cameras and projectors of a rig, and the whole of a rig file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sms_jobs.errors import InvalidInput
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
        a set is recorded. "unplugged": nothing is heard of the camera any more.
    state
        Label of the load state at which it happens; empty for every state.
    frame
        Count of the camera's triggers at that state, from 1, at which it happens.
    """

    fault: Literal["dropped-frame", "flash", "unplugged"]
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


@dataclass(frozen=True)
class ProjectorInstrument(OpticalInstrument):
    """A projector and how it is reached."""

    @property
    def settle_s(self) -> float:
        """How long a picture takes to be on, in s; 0 where its file does not say it, in `settle_ms`."""
        return float(getattr(self, "settle_ms", 0.0)) / 1e3


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


@dataclass(frozen=True)
class VirtualProjector(ProjectorInstrument):
    """A projector that lights the virtual rig.

    Attributes
    ----------
    settle_ms
        Between handing over a picture and light: the display's and the projector's delay.
    """

    driver: Literal["simulated"]
    settle_ms: float = 50.0


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
