"""What quick looks have found, as it is shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import datetime

from sms_jobs.records.statistic_names import of_gauge, with_sigma


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

    @classmethod
    def of(cls, gauge: str, statistics: Mapping[str, float]) -> GaugeLook:
        """Return what the statistics of a quick look say of a gauge that has a value."""
        names = [one.name for one in fields(cls)[1:]]
        return cls(gauge, **{name: statistics[of_gauge(gauge, name)] for name in names})

    def read(self, quantity: str) -> tuple[float, float]:
        """Return one of `GAUGE_QUANTITIES` and its standard deviation."""
        return getattr(self, quantity), getattr(self, with_sigma(quantity))


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
        What is doubted, which gauges have no value and why, or why it failed; empty where nothing is.
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
