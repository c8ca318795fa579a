"""Waits for jobs while showing how they come along."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.cli.output import progress_bar
from sms_jobs.errors import WaitTimedOut
from sms_jobs.jobs import inquiry
from sms_jobs.records.job import UNSUCCESSFUL, JobState

_EVERY_S = 0.25


def wait_for(
    catalogue: Catalogue,
    job_ids: Sequence[str],
    timeout_s: float | None,
    tell: Callable[[dict[str, int]], None] = lambda counted: None,
    still_there: Callable[[], None] = lambda: None,
) -> dict[str, int]:
    """Return how many of some jobs ended in each state, once all have.

    Parameters
    ----------
    tell
        Called with the counts whenever they change.
    still_there
        Called all the time; may raise to end the waiting.

    Raises
    ------
    WaitTimedOut
        They have not ended in time; they go on.
    """
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    before: dict[str, int] = {}
    with progress_bar() as bar:
        task = bar.add_task("jobs", total=len(job_ids))
        while True:
            with catalogue.reading() as session:
                counted = inquiry.counts(session, job_ids=job_ids)
                running = inquiry.running(session, job_ids)
            active = inquiry.still_active(counted)
            bar.update(task, completed=len(job_ids) - active, description=running or "jobs")
            if counted != before:
                tell(counted)
                before = counted
            if not active:
                return counted
            if deadline is not None and time.monotonic() > deadline:
                raise WaitTimedOut(
                    f"{active} of {len(job_ids)} jobs have not ended after {timeout_s:g} s; they go on; "
                    "see 'sms job list'"
                )
            still_there()
            time.sleep(_EVERY_S)


def unsuccessful(counted: dict[str, int]) -> int:
    """Return how many of some counted jobs ended without success."""
    return sum(counted.get(state.value, 0) for state in UNSUCCESSFUL)


def succeeded(counted: dict[str, int]) -> int:
    """Return how many of some counted jobs ended with success."""
    return counted.get(JobState.SUCCEEDED.value, 0)
