"""What somebody wants to be recorded and when, in words and numbers as programs give them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from sms_jobs.app.measuring.planned_recordings import AtCycles, AtLevels, AtLoad, InTime, When
from sms_jobs.errors import InvalidInput
from sms_jobs.records.gauge_limits import Look, gauge_limit
from sms_jobs.records.units import typed

DAY_S = 86400.0
LONGEST_EVERY_S, LONGEST_HOLD_S = 30.0 * DAY_S, DAY_S
MOST_COUNTS = 1000


@dataclass(frozen=True)
class PlanWish:
    """States that are to be recorded, and one thing that each waits for; without any, the one before it.

    Attributes
    ----------
    states
        Labels; all that are not recorded, planned or skipped if there is none.
    every_s
        One after so many seconds.
    channel, tolerance
        What is waited for, and how near it has to be to its value at a state, with its unit, as 500N.
    each
        Add a state at each multiple of this load, as 10kN; with a channel and a tolerance.
    at_cycles
        Numbers of cycles, a state at each; the channel is then that which counts.
    hold_s
        How long the channel must have stayed there.
    ask, process
        Whether an operator is asked about a doubtful set, and whether each state is processed.
    look, stop_if
        Whether each state has a quick look, and the limits that hold the plan, which need one.
    """

    states: tuple[str, ...] = ()
    every_s: float | None = None
    channel: str | None = None
    tolerance: str | None = None
    each: str | None = None
    at_cycles: tuple[int, ...] | None = None
    hold_s: float = 5.0
    ask: bool = False
    process: bool = False
    look: bool = False
    stop_if: tuple[str, ...] = ()

    @property
    def looked_at(self) -> Look:
        """Whether there are quick looks, and which limits hold the plan; `InvalidInput` for anything else."""
        limits = tuple(gauge_limit(text, "stop_if") for text in self.stop_if)
        return Look(self.look or bool(limits), limits)

    @property
    def when(self) -> When:
        """What is waited for; raises `InvalidInput` for several things, or half of one."""
        self._require_ranges()
        at_load = self.channel is not None and self.at_cycles is None
        if [at_load, self.at_cycles is not None, self.every_s is not None].count(True) > 1:
            raise InvalidInput("give one thing to wait for: every_s, at_cycles, or channel with tolerance")
        if self.each is not None and not at_load:
            raise InvalidInput("each goes with channel and tolerance, and without at_cycles: leave it out")
        if at_load is (self.tolerance is None):
            raise InvalidInput(
                "channel and tolerance go together, and without at_cycles: state how near the channel "
                "must be to a state's value, such as 500N"
            )
        if self.at_cycles is not None:
            if any(later <= earlier for earlier, later in pairwise(self.at_cycles)):
                raise InvalidInput("at_cycles: each number should exceed the one before")
            return AtCycles(self.at_cycles, self.channel or "cycles", self.hold_s)
        if self.channel is not None and self.tolerance is not None:
            near = typed(self.tolerance, "tolerance")
            if self.each is not None:
                return AtLevels(self.channel, typed(self.each, "each"), near, self.hold_s)
            return AtLoad(self.channel, near, self.hold_s)
        return InTime(self.every_s)

    def _require_ranges(self) -> None:
        if self.every_s is not None and not 1.0 <= self.every_s <= LONGEST_EVERY_S:
            raise InvalidInput(f"every_s is {self.every_s:g}; give 1 s to {LONGEST_EVERY_S:g} s")
        if not 0.0 <= self.hold_s <= LONGEST_HOLD_S:
            raise InvalidInput(f"hold_s is {self.hold_s:g}; give 0 s to {LONGEST_HOLD_S:g} s")
        if self.at_cycles is not None and not 1 <= len(self.at_cycles) <= MOST_COUNTS:
            raise InvalidInput(
                f"at_cycles has {len(self.at_cycles)} numbers of cycles; give 1 to {MOST_COUNTS}"
            )
