"""What is known of the states of a test while it goes on."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class StateProgress:
    """What is known of a state.

    Attributes
    ----------
    label
        Of the state.
    load_n
        As planned, if it is.
    recording
        State of the job that records it; empty before there is one, "recorded" once it lies in the archive.
    recorded_at
        When its last view was archived.
    views, judged, doubtful
        How many are recorded, of several cameras each, how many of these were judged when they were, and how
        many are doubted.
    channels
        What was read before its sets, by name: of the last view.
    processing, failed, skipped, cancelled
        Jobs that are to process it and have not ended; that failed, or wait for somebody to mend them; that
        never ran because of another; and that somebody called off.
    displacement_mm, strain
        Largest displacement and largest principal strain of all views; None before they are computed.
    """

    label: str
    load_n: float | None
    recording: str
    recorded_at: datetime | None
    views: int
    judged: int
    doubtful: int
    channels: dict[str, float]
    processing: int
    failed: int
    skipped: int
    cancelled: int
    displacement_mm: float | None
    strain: float | None
