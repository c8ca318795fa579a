"""What happens beside jobs, as it is told to those who follow it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import Enum


class Followed(Enum):
    """What changes are told of."""

    RECORDING = "recording"
    """A planned recording: planned, held, released, moved, skipped, dropped, begun, recorded; then looked-at,
    or stopped where its quick look holds the plan. Where it breaks off it is as its job: failed,
    needs-operator, cancelled or quarantined."""
    CALIBRATION = "calibration"
    """A calibration: entered, accepted or withdrawn."""
    SCHEDULE = "schedule"
    """A schedule: added, paused, resumed, removed, fired, missed or failed."""


@dataclass(frozen=True)
class Change:
    """A change of a planned recording, a calibration or a schedule.

    Attributes
    ----------
    number
        Of its row; rows are numbered before they are committed, and may become visible in another order.
    topic
        What has changed; see `Followed`.
    name
        Which one: campaign and state of a recording, number of a calibration, name of a schedule.
    campaign
        That it is about; empty for what is about several, or about none.
    state
        That it has come to; see `Followed`.
    message
        What else there is to say, such as what a schedule has submitted.
    at
        When.
    """

    number: int
    topic: str
    name: str
    campaign: str
    state: str
    message: str
    at: datetime
