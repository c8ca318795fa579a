"""The newest frame of a recording, for whoever watches it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime


@dataclass(frozen=True)
class LastFrame:
    """What is known of the newest frame of a recording.

    Attributes
    ----------
    job
        Id of its job.
    view
        Of which it is; of a stream, or of a camera without a projector, the camera.
    number, frames
        Which one of its set it is, counted from 1, and how many there are to be.
    taken_at
        By the clock of the camera.
    rows, columns
        Of the whole frame.
    saturated_fraction
        Part of its pixels that are at full scale.
    channels
        What channels read last that is on record: before its set, or while it was streamed; by name.
    sealed
        Whether it lies in the archive, and not in the spool of this host any more.
    """

    job: str
    view: str
    number: int
    frames: int
    taken_at: datetime
    rows: int
    columns: int
    saturated_fraction: float
    channels: Mapping[str, float] = field(default_factory=dict)
    sealed: bool = False
