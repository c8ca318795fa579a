"""The cameras and projectors of a rig, and the whole of a rig file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sms_jobs.errors import InvalidInput
from sms_jobs.records.campaign import checked_name
from sms_jobs.records.instruments import Instruments, Stage


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
class CameraInstrument:
    """A camera and how it is reached.

    Attributes
    ----------
    name
        C1, C2, ...
    driver
        "simulated" looks at the virtual rig.
    columns, rows
        Of its image, in pixels.
    faults
        What a simulated one is to do wrong.
    """

    name: str
    driver: Literal["simulated"]
    columns: int
    rows: int
    faults: tuple[OpticalFault, ...] = ()


@dataclass(frozen=True)
class ProjectorInstrument:
    """A projector and how it is reached.

    Attributes
    ----------
    name
        P1, P2, ...
    driver
        "simulated" lights the virtual rig.
    columns, rows
        Of its image, in pixels.
    settle_ms
        Between handing over a picture and light: the display's and the projector's delay.
    """

    name: str
    driver: Literal["simulated"]
    columns: int
    rows: int
    settle_ms: float = 50.0


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

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of its cameras, then of its projectors."""
        return (*(c.name for c in self.cameras), *(p.name for p in self.projectors))

    @property
    def stage(self) -> Stage | None:
        """The first stage, which carries calibration artefacts."""
        return self.serial.stages[0] if self.serial.stages else None

    @property
    def devices(self) -> tuple[str, ...]:
        """Names of all instruments, sorted: what a recording locks."""
        return tuple(sorted([*self.sensors, *(d.name for d in self.serial.serial)]))
