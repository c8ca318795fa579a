"""What a rig file says of a GenICam camera, whoever carries its words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.real_cameras import RealCamera

SOFTWARE, ACQUISITION = "software", "acquisition"

PixelFormat: TypeAlias = Literal[
    "Mono8",
    "Mono10",
    "Mono12",
    "Mono14",
    "Mono16",
    "Mono10p",
    "Mono12p",
    "Mono10Packed",
    "Mono12Packed",
]


@dataclass(frozen=True)
class GenicamSettings(RealCamera):
    """What is set in any GenICam camera.

    Attributes
    ----------
    device
        Which camera: its serial number or identifier.
    pixel_format
        Of the images it sends.
    exposure_ms
        At the exposure 1 of a sequence; 0 for a camera that has no such feature.
    gain
        In the camera's unit; None leaves it as it is.
    offset_x, offset_y
        Of the region of interest on its sensor, in pixels.
    trigger
        "software", the name of the line that a trigger controller is wired to, such as "Line1", or
        "acquisition" for a camera that cannot be triggered: then every frame is the first of an acquisition.
    pulse_line
        The line that a projector's pulses come in by, such as "Line2"; empty where none do.
    readout_ms
        How long after an exposure it does not take the next pulse; 0 where it exposes while it reads out.
    features
        What else is set when it is connected, by standard names and before everything else.
    """

    device: str
    pixel_format: PixelFormat
    exposure_ms: float = 0.0
    gain: float | None = None
    offset_x: int = 0
    offset_y: int = 0
    trigger: str = SOFTWARE
    pulse_line: str = ""
    readout_ms: float = 0.0
    features: Mapping[str, bool | int | float | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.exposure_ms <= 60e3:
            raise InvalidInput(
                f"camera {self.name} is to expose for {self.exposure_ms} ms: from 0 to 60000 ms are possible"
            )
        if min(self.offset_x, self.offset_y) < 0 or not self.trigger or not self.device:
            raise InvalidInput(
                f"camera {self.name} needs offsets of 0 or more, a trigger and a device, not "
                f"{self.offset_x}, {self.offset_y}, '{self.trigger}' and '{self.device}'"
            )
        if not 0.0 <= self.readout_ms <= 60e3 or (self.pulse_line and self.trigger == ACQUISITION):
            raise InvalidInput(
                f"camera {self.name} has readout_ms = {self.readout_ms}, trigger = '{self.trigger}' and "
                f"pulse_line = '{self.pulse_line}': from 0 to 60000 ms are possible, and pulses only where "
                "it can be triggered"
            )

    @property
    def wired(self) -> bool:
        """Whether it is exposed through a wire from a trigger controller."""
        return self.trigger not in (SOFTWARE, ACQUISITION)

    @property
    def pulsed(self) -> bool:
        """Whether a projector's pulses can expose it."""
        return bool(self.pulse_line)
