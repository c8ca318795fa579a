"""What a planned recording waits for before it begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any, ClassVar, TypeAlias

from sms_jobs.records.units import time_words


@dataclass(frozen=True)
class InTurn:
    """It begins as soon as what is planned before it has ended."""

    form: ClassVar[str] = "next"

    def __str__(self) -> str:
        return "in its turn"


@dataclass(frozen=True)
class Every:
    """It begins so many seconds after the recording before it was due."""

    form: ClassVar[str] = "every"
    seconds: float

    def __str__(self) -> str:
        return f"every {time_words(self.seconds)}"

    def due(self, before: datetime | None, now: datetime) -> datetime | None:
        """Return by which time a recording begins, on a grid that has the one before it; None before then.

        Parameters
        ----------
        before
            When the last one was due; None where there was none, after which one begins at once.

        Of times that passed with nobody there the last one counts, so that none are made up for in a row.
        """
        if before is None:
            return now
        passed = (now - before) // timedelta(seconds=self.seconds)
        return before + passed * timedelta(seconds=self.seconds) if passed > 0 else None

    def next_time(self, before: datetime | None) -> datetime | None:
        """Return when a recording is due; None where that is at once."""
        return None if before is None else before + timedelta(seconds=self.seconds)


@dataclass(frozen=True)
class Holding:
    """It begins when a channel has stayed near what the test plan says of its state.

    Attributes
    ----------
    channel, unit
        Of the rig, and the unit of its readings and of the numbers here.
    target, tolerance
        It is within `tolerance` of `target`.
    for_s
        How long it must have stayed there.
    """

    form: ClassVar[str] = "holding"
    channel: str
    unit: str
    target: float
    tolerance: float
    for_s: float

    def __str__(self) -> str:
        near = f"{self.channel} = {self.target:g} +- {self.tolerance:g} {self.unit}"
        return f"{near} for {time_words(self.for_s)}"


@dataclass(frozen=True)
class Counted:
    """It begins when a counter of the rig has come to a number and stands still.

    Attributes
    ----------
    channel
        That counts.
    count
        Which it must have reached.
    for_s
        How long it must have stood still; 0 where the machine goes on.
    """

    form: ClassVar[str] = "cycles"
    channel: str
    count: int
    for_s: float

    def __str__(self) -> str:
        still = f", still for {time_words(self.for_s)}" if self.for_s else ""
        return f"{self.channel} >= {self.count}{still}"


Trigger: TypeAlias = InTurn | Every | Holding | Counted
Watched: TypeAlias = Holding | Counted
"""Triggers that follow from what a channel reads."""

_FORMS: Mapping[str, type[Trigger]] = {each.form: each for each in (InTurn, Every, Holding, Counted)}


def as_json(trigger: Trigger) -> dict[str, Any]:
    """Return a trigger as the catalogue keeps it."""
    return {"form": trigger.form, **asdict(trigger)}


def from_json(kept: Mapping[str, Any]) -> Trigger:
    """Read it back."""
    return _FORMS[kept["form"]](**{name: value for name, value in kept.items() if name != "form"})
