"""What quick looks have found, as it is shown."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class GaugeLook:
    """What a gauge reads, in mm, each with its standard deviation.

    Attributes
    ----------
    name
        Of the gauge.
    extension_mm
        By how much the distance of its ends has grown.
    x_mm, y_mm, z_mm
        Displacement of its middle in the specimen's frame.
    """

    name: str
    extension_mm: float
    extension_sigma_mm: float
    x_mm: float
    x_sigma_mm: float
    y_mm: float
    y_sigma_mm: float
    z_mm: float
    z_sigma_mm: float


@dataclass(frozen=True)
class QuickLookView:
    """The newest quick look at a tuple.

    Attributes
    ----------
    campaign, state, view
        That it is about.
    job_id, status
        Of its job.
    looked_at
        When it was there; None before.
    valid_fraction
        Which part of what is lit has a shape; None before it is known.
    gauges
        Those that have a value.
    gauges_lost
        How many have none.
    doubts
        What is doubted, or why it failed; empty where nothing is.
    """

    campaign: str
    state: str
    view: str
    job_id: str
    status: str
    looked_at: datetime | None
    valid_fraction: float | None
    gauges: tuple[GaugeLook, ...]
    gauges_lost: int
    doubts: str
