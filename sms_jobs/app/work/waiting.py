"""Waits for jobs, and tells how they come along."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import JobFailed, WaitTimedOut
from sms_jobs.jobs.asking import inquiry, standing
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.planning.estimates import outlook
from sms_jobs.jobs.running.empty_results import EmptyResults, empty_results
from sms_jobs.jobs.running.remarks import remarks
from sms_jobs.records.job import UNSUCCESSFUL, JobState
from sms_jobs.records.people import Right
from sms_jobs.records.shown.estimates import Outlook
from sms_jobs.records.shown.remarks import Remarks
from sms_jobs.records.sizes import number_of

_EVERY_S = 0.25
_OUTLOOK_EVERY_S = 5.0
_SHARE = 10.0
"""So many times as long as looking takes is waited before looking again."""


@dataclass(frozen=True)
class Waiting:
    """How jobs stand that are waited for.

    Attributes
    ----------
    counted
        How many are in each state.
    active
        How many have not ended.
    running
        What runs, in a few words; empty where nothing does.
    outlook
        How the rest comes along; None once all have ended.
    """

    counted: dict[str, int]
    active: int
    running: str
    outlook: Outlook | None

    @property
    def total(self) -> int:
        """How many there are."""
        return sum(self.counted.values())


@dataclass(frozen=True)
class Waited:
    """How jobs ended.

    Attributes
    ----------
    counted
        How many in each state.
    failure
        Where one did not succeed, what the last of these says.
    empty
        Results in which nothing is valid, of jobs that succeeded.
    remarks
        What jobs that succeeded remark about their data, by kind.
    """

    counted: dict[str, int]
    failure: str = ""
    empty: EmptyResults = EmptyResults()
    remarks: tuple[Remarks, ...] = ()

    @property
    def succeeded(self) -> int:
        """How many ended with success."""
        return self.counted.get(JobState.SUCCEEDED.value, 0)

    @property
    def failures(self) -> int:
        """How many ended without."""
        return sum(self.counted.get(state.value, 0) for state in UNSUCCESSFUL)

    def require_success(self) -> None:
        """Raise `JobFailed` where one did not succeed."""
        if self.failures:
            total = sum(self.counted.values())
            raise JobFailed(f"{self.failures} of {number_of(total, 'job')} did not succeed; {self.failure}")


def timed_out(active: int, counted: dict[str, int], timeout_s: float) -> WaitTimedOut:
    """Say that jobs have not ended in time."""
    return WaitTimedOut(
        f"{active} of {number_of(sum(counted.values()), 'job')} {'has' if active == 1 else 'have'} not ended "
        f"after {timeout_s:g} s; they go on; see 'sms job list'"
    )


@use_case(Right.READ)
def wait_for(
    services: Services,
    some: Chosen,
    timeout_s: float | None = None,
    tell: Callable[[Waiting], None] = lambda waiting: None,
) -> Waited:
    """Return how some jobs ended, once all have.

    Parameters
    ----------
    timeout_s
        After which nobody waits any more; None for never.
    tell
        Called at every look; may raise to end the waiting.

    Raises
    ------
    WaitTimedOut
        They have not ended in time; they go on.
    """
    began = datetime.now(UTC)
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    before: dict[str, int] = {}
    outlook_at = soonest = 0.0
    ahead: Outlook | None = None
    while True:
        looked = time.monotonic()
        with services.catalogue.reading() as session:
            counted = inquiry.counts(session, some)
            running = inquiry.running(session, some)
            active = standing.still_active(counted)
            if active and looked >= (soonest if counted != before else outlook_at):
                ahead = outlook(session, some, services.settings.workers)
                soonest = looked + _SHARE * (time.monotonic() - looked)
                outlook_at = max(soonest, looked + _OUTLOOK_EVERY_S)
        before = counted
        tell(Waiting(counted, active, running, ahead if active else None))
        if not active:
            break
        if deadline is not None and time.monotonic() > deadline:
            raise timed_out(active, counted, timeout_s or 0.0)
        taken = time.monotonic() - looked
        time.sleep(min(max(_EVERY_S, taken), _OUTLOOK_EVERY_S))
    with services.catalogue.reading() as session:
        empty, told = empty_results(session, some, began), remarks(session, some, began)
        done = Waited(counted, empty=empty, remarks=told)
        return replace(done, failure=inquiry.failure(session, some)) if done.failures else done
