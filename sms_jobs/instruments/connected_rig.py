"""The instruments of a rig once they are connected."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.protocols import (
    Camera,
    Channel,
    DirectVideo,
    Fired,
    Lamp,
    Projector,
    SoftwareTrigger,
    Stage,
    StandingLamp,
    Trigger,
    Video,
    recorded_value,
)
from sms_jobs.records.bursts import Burst
from sms_jobs.records.scene import Simulation


def _stepped(projector: str, cameras: Collection[str], frames: int, exposure: float) -> None:
    """Have every pattern shown by a command."""


@dataclass(frozen=True)
class ConnectedRig:
    """The instruments of a rig, connected.

    Attributes
    ----------
    name
        Of the rig.
    cameras, projectors
        By name: C1, ..., P1, ...
    clock
        Of the rig.
    trigger
        What makes the cameras expose; None for a trigger over the link of each.
    channels
        Scalar readings, by name.
    stage
        That carries a calibration artefact; None where there is none.
    video
        What brings the picture to a projector.
    simulation
        What a view truly sees now; None for real instruments.
    described
        What each sensor said of itself when it was connected, by name.
    lamp
        What lights a specimen that is recorded without a projector.
    burst
        How a projector plays so many patterns to some cameras with an exposure, see `RigFile.burst`.
    """

    name: str
    cameras: Mapping[str, Camera]
    projectors: Mapping[str, Projector]
    clock: Clock
    trigger: Trigger | None = None
    channels: Mapping[str, Channel] = field(default_factory=dict)
    stage: Stage | None = None
    video: Video = field(default_factory=DirectVideo)
    simulation: Callable[[str], Simulation] | None = None
    described: Mapping[str, str] = field(default_factory=dict)
    lamp: Lamp = field(default_factory=StandingLamp)
    burst: Callable[[str, Collection[str], int, float], Burst | None] = _stepped

    def fire(self, cameras: Mapping[str, Camera]) -> Mapping[str, Fired]:
        """Expose some cameras together, and return by name when that was."""
        return (self.trigger or SoftwareTrigger(self.clock)).fire(cameras)

    def read_channels(self) -> dict[str, float]:
        """Return what every channel reads now, as it is recorded: in the unit of its name."""
        return {name: recorded_value(name, one, one.read()) for name, one in self.channels.items()}
