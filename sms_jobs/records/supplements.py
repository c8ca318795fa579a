"""What a person says of a calibration that its file does not say."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime

from sms_jobs.records.sensors import Box


@dataclass(frozen=True)
class Supplement:
    """What a person says of a file that does not say it itself.

    Attributes
    ----------
    rig, valid_from, volume
        Win over what the file says.
    names
        C1, P1, ... of the sensors, in the order of the file; by default cameras and projectors are counted.
    sizes
        Columns and rows of sensors, by name.
    millimetres_per_unit
        Of the lengths in the file.
    """

    rig: str | None = None
    valid_from: datetime | None = None
    volume: Box | None = None
    names: tuple[str, ...] = ()
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    millimetres_per_unit: float = 1.0
