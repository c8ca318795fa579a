"""Waits for jobs while showing how they come along, how fast, and when they will have ended."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.cli.output import clock, duration, job_bar
from sms_jobs.errors import WaitTimedOut
from sms_jobs.jobs import inquiry
from sms_jobs.jobs.chosen import Chosen
from sms_jobs.jobs.estimates import outlook
from sms_jobs.records.estimates import Estimate, Outlook
from sms_jobs.records.job import UNSUCCESSFUL, JobState

_EVERY_S = 0.25
_OUTLOOK_EVERY_S = 5.0
_SHARE = 10.0
"""So many times as long as looking takes is waited before looking again."""


def as_json(outlook: Outlook) -> dict[str, Any]:
    """Return how jobs come along for programs."""
    return {"jobs_per_minute": outlook.per_minute, "estimate": outlook.estimate}


def told_outlook(outlook: Outlook) -> str:
    """Say how fast jobs come along, and when the rest will have ended."""
    rate = "" if outlook.per_minute is None else f"{outlook.per_minute:.3g} jobs/min, "
    return rate + told(outlook.estimate)


def told(estimate: Estimate) -> str:
    """Say when jobs will have ended, and what that depends on."""
    one = "worker" if estimate.workers == 1 else "workers"
    where = f"on {estimate.workers} {one}" + ("" if estimate.alive else " once 'sms up' runs")
    new = ", ".join(f"{kind} ({count})" for kind, count in estimate.unknown.items())
    if estimate.jobs and estimate.reused == estimate.jobs:
        return f"nothing has to be computed: {estimate.jobs} of {estimate.jobs} are reused"
    if estimate.unserved:
        say = f"no end in sight: no worker serves the queue {', '.join(estimate.unserved)}"
    elif estimate.seconds is None or estimate.ready_at is None:
        say = f"no estimate: there is no history yet of {new}"
    else:
        span = duration(estimate.seconds)
        ready = clock(estimate.ready_at, datetime.now(UTC))
        if new:
            say = f"at least {span} {where}, not before {ready}; there is no history yet of {new}"
        else:
            say = f"about {span} {where}" + (f"; ready {ready}" if estimate.alive else "")
    if estimate.reused:
        say += f"; {estimate.reused} of {estimate.jobs} are reused"
    if estimate.looked_at is not None:
        say += f"; roughly, told by {estimate.looked_at} of the jobs, whatever may be reused"
    if estimate.paused:
        say += f"; paused: {', '.join(estimate.paused)}"
    return say


def wait_for(
    catalogue: Catalogue,
    chosen: Chosen,
    timeout_s: float | None,
    tell: Callable[[dict[str, int], Outlook | None], None] = lambda counted, ahead: None,
    still_there: Callable[[], None] = lambda: None,
    workers: int = 1,
) -> dict[str, int]:
    """Return how many of some jobs ended in each state, once all have.

    Parameters
    ----------
    tell
        Called with the counts whenever they change, and how the rest comes along; that is None at the end.
    still_there
        Called all the time; may raise to end the waiting.
    workers
        Counted on for the time left while none is alive.

    Raises
    ------
    WaitTimedOut
        They have not ended in time; they go on.
    """
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    before: dict[str, int] = {}
    outlook_at = soonest = 0.0
    ahead: Outlook | None = None
    with job_bar() as bar:
        task = bar.add_task("jobs", total=None, pace="")
        while True:
            looked = time.monotonic()
            with catalogue.reading() as session:
                counted = inquiry.counts(session, chosen)
                running = inquiry.running(session, chosen)
                active = inquiry.still_active(counted)
                if active and looked >= (soonest if counted != before else outlook_at):
                    ahead = outlook(session, chosen, workers)
                    soonest = looked + _SHARE * (time.monotonic() - looked)
                    outlook_at = max(soonest, looked + _OUTLOOK_EVERY_S)
            total = sum(counted.values())
            bar.update(
                task,
                total=total,
                completed=total - active,
                description=running or "jobs",
                pace="" if ahead is None else told_outlook(ahead),
            )
            if counted != before:
                tell(counted, ahead if active else None)
                before = counted
            if not active:
                return counted
            if deadline is not None and time.monotonic() > deadline:
                raise WaitTimedOut(
                    f"{active} of {total} jobs have not ended after {timeout_s:g} s; they go on; "
                    "see 'sms job list'"
                )
            still_there()
            taken = time.monotonic() - looked
            time.sleep(min(max(_EVERY_S, taken), _OUTLOOK_EVERY_S))


def unsuccessful(counted: dict[str, int]) -> int:
    """Return how many of some counted jobs ended without success."""
    return sum(counted.get(state.value, 0) for state in UNSUCCESSFUL)


def succeeded(counted: dict[str, int]) -> int:
    """Return how many of some counted jobs ended with success."""
    return counted.get(JobState.SUCCEEDED.value, 0)
