"""Named runs as they are shown: what submissions under a name have given, and what differs between two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal, TypeAlias

What: TypeAlias = Literal["parameter", "input", "calibration", "version", "definition"]


@dataclass(frozen=True)
class RunView:
    """A run in short.

    Attributes
    ----------
    campaigns
        Names of those that were submitted under it.
    submissions
        How often.
    jobs
        How many of its jobs are in each state.
    kept_at
        Since when no policy removes its results, and nothing is added to it; None for a run that is open.
    reason
        Why it is kept.
    """

    name: str
    created_at: datetime
    created_by: str
    campaigns: tuple[str, ...]
    submissions: int
    jobs: Mapping[str, int]
    kept_at: datetime | None
    reason: str


@dataclass(frozen=True)
class RunResult:
    """What a run names of one kind and subject: the result of its newest job that succeeded.

    Attributes
    ----------
    job
        The job of the run; where it was answered by an earlier result, `made_by` is the one that made that.
    parameters
        All of them, defaults included.
    files
        Numbers of the files; none where a policy has removed them.
    inputs
        By role, number and kind of what it was computed from.
    calibrations
        Numbers of those that it was computed with, directly or through its inputs.
    """

    kind: str
    version: int
    subject: str
    job: str
    made_by: str
    parameters: Mapping[str, Any]
    files: tuple[int, ...]
    inputs: Mapping[str, str]
    calibrations: tuple[int, ...]


@dataclass(frozen=True)
class RunStory:
    """A run with all that it names.

    Attributes
    ----------
    parameters
        Values of parameters that were given to it, by `kind.name`; those given last.
    results
        In order of kind and subject.
    missing
        Subjects by kind, of which no job has succeeded, each with the state of the newest.
    """

    run: RunView
    parameters: Mapping[str, Any]
    results: tuple[RunResult, ...]
    missing: Mapping[str, str]

    @property
    def removed(self) -> int:
        """How many results have no file any more."""
        return sum(not one.files for one in self.results)


@dataclass(frozen=True)
class RunChange:
    """What was not the same in two runs, over all subjects of a kind.

    Attributes
    ----------
    name
        Of the parameter, or the role of the input; empty where there is one of its sort.
    before, after
        Values, or what they were; of several the first, by subject.
    results
        How many results it is about.
    intended
        Whether that was asked for: a parameter that was given otherwise or, where none was, the version.
    """

    what: What
    kind: str
    name: str
    before: Any
    after: Any
    results: int
    intended: bool


@dataclass(frozen=True)
class Difference:
    """By how much one quantity of one subject differs: after minus before.

    Attributes
    ----------
    files
        Before and after.
    points
        Pixels, or gauges, that have a value in both.
    gained, lost
        Those that have one after alone, and before alone.
    rms, median, largest
        In `unit`; the median with its sign, the largest as a size. None without points.
    sigma
        Rms of the standard deviation of the difference, as if both had noise of their own.
    beyond
        Part of the points that changed by more than twice that; None where it is not known of any.
    """

    subject: str
    quantity: str
    unit: str
    files: tuple[int, int]
    points: int
    gained: int
    lost: int
    rms: float | None
    median: float | None
    largest: float | None
    sigma: float | None
    beyond: float | None


@dataclass(frozen=True)
class RunComparison:
    """What differs between two runs.

    Attributes
    ----------
    before, after
        Their names.
    changes
        What was not the same, what was asked for first.
    differences
        Of displacement, strain and gauges that two results differ by.
    same
        How many results of these are the same in both, to the last bit.
    only_before, only_after
        Results by kind that one of them has alone.
    unlike
        Results that cannot be subtracted, each with why.
    """

    before: str
    after: str
    changes: tuple[RunChange, ...]
    differences: tuple[Difference, ...]
    same: int
    only_before: Mapping[str, int] = field(default_factory=dict)
    only_after: Mapping[str, int] = field(default_factory=dict)
    unlike: tuple[str, ...] = ()

    @property
    def unasked(self) -> tuple[RunChange, ...]:
        """What changed that nobody asked for."""
        return tuple(change for change in self.changes if not change.intended)
