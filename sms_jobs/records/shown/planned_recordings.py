"""What is planned to be recorded while a test goes on, and what it waits for."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import Enum


class Status(Enum):
    """How far a planned recording has come."""

    PLANNED = "planned"
    BEGUN = "begun"
    RECORDED = "recorded"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class PlannedRecording:
    """One recording of a plan.

    Attributes
    ----------
    campaign, state
        Of which it is.
    is_added
        Whether the campaign is given the state only when a load is held; it has none of that label yet.
    trigger
        What it waits for, in words.
    status
        "planned", "held", "recorded" or "skipped"; once it has started, the state of its job.
    is_next
        Whether it comes next.
    waits_for
        Of the next one, what keeps it from being recorded now; empty for others.
    unless_read
        The same but for what its channel read last, which changes while it waits.
    due_at
        When it was due, once it has started.
    seen, seen_at
        What its channel read last, and when; None where it waits for none.
    job_id
        Of its recording; None before it has started.
    planned_by
        Who has planned it.
    note
        What was found when it was recorded, or keeps its channel from being read; empty where nothing does.
    stop_if
        Limits beyond which the quick look at it holds the plan.
    stopped_by
        What has held the plan after it; empty where nothing has, or it goes on again.
    """

    campaign: str
    state: str
    trigger: str
    status: str
    is_next: bool
    waits_for: str
    unless_read: str
    due_at: datetime | None
    seen: float | None
    seen_at: datetime | None
    job_id: str | None
    planned_by: str
    note: str
    stop_if: tuple[str, ...]
    stopped_by: str
    is_added: bool = False


@dataclass(frozen=True)
class Dropped:
    """What became of a plan that was forgotten, or of some of its states.

    Attributes
    ----------
    forgotten
        States that are not recorded by it any more.
    recorded
        Those that it has recorded; what was recorded stays, and the plan lists them no longer.
    running
        Those that are being recorded, which go on and stay in the plan.
    """

    forgotten: tuple[str, ...]
    recorded: tuple[str, ...] = ()
    running: tuple[str, ...] = ()
