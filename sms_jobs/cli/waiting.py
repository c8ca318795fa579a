"""Shows how jobs come along, how fast, and when they will have ended."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from sms_jobs.cli import output
from sms_jobs.cli.output import clock, duration
from sms_jobs.records.sizes import number_of

if TYPE_CHECKING:
    from sms_jobs.app.work.waiting import Waiting
    from sms_jobs.records.shown.estimates import Estimate, Outlook
    from sms_jobs.records.shown.remarks import Remarks

_NO_WORKER = "no worker is there: start one with 'sms up'"
_STARTS_WITHIN_S = 10.0
"""A service that was started just before is not missed."""


@contextmanager
def followed(stop: str = "") -> Iterator[Callable[[Waiting], None]]:
    """Show on a bar how the jobs come along that are waited for.

    Where there is no terminal for it, say what would never end: that no worker is there, or serves them. Who
    interrupts the waiting is told that the jobs go on, and which command, `stop`, ends them, if it is given.
    """
    from sms_jobs.cli.bars import job_bar

    with job_bar() as bar:
        task = bar.add_task("jobs", total=None, pace="")
        said: set[str] = set()
        there_at = time.monotonic()

        def tell(now: Waiting) -> None:
            bar.update(
                task,
                total=now.total,
                completed=now.total - now.active,
                description=now.running or "jobs",
                pace="" if now.outlook is None else outlook_text(now.outlook),
            )
            if now.outlook is None or not bar.disable:
                return
            nonlocal there_at
            estimate = now.outlook.estimate
            if estimate.alive:
                there_at = time.monotonic()
            late = time.monotonic() - there_at >= _STARTS_WITHIN_S
            why = _unserved(estimate) or _paused(estimate) or (_NO_WORKER if late else "")
            if why and why not in said:
                said.add(why)
                output.say(f"waiting, with no end in sight: {why}")

        try:
            yield tell
        except KeyboardInterrupt:
            if stop:
                output.say(f"what was submitted goes on: 'sms job list' shows it, and '{stop}' stops it")
            raise


def _paused(estimate: Estimate) -> str:
    """Say which queues are paused, and where the reason stands; nothing where none is."""
    queues = ", ".join(estimate.paused)
    return queues and f"the queue {queues} is paused: 'sms queue list' says why"


def _unserved(estimate: Estimate) -> str:
    """Say which queues no worker serves, and what to do; nothing where each is served."""
    queues = ", ".join(estimate.unserved)
    return queues and f"no worker serves the queue {queues}: start 'sms up', for a rig on its host"


def tell_remarks(remarks: Iterable[Remarks]) -> None:
    """Say what jobs remark about their data, the first of each kind, and where the others stand."""
    for of_kind in remarks:
        for said in of_kind.first:
            output.say(f"note: {of_kind.kind} {said}")
        if more := of_kind.jobs - len(of_kind.first):
            output.say(
                f"note: {number_of(more, 'more job')} of {of_kind.kind} remark{'s' if more == 1 else ''} "
                f"something: see 'sms job list --kind {of_kind.kind}'"
            )


def remarks_as_json(remarks: Sequence[Remarks]) -> dict[str, Any]:
    """Return what jobs remark about their data for programs; nothing where they remark nothing."""
    return {"remarks": remarks} if remarks else {}


def as_json(outlook: Outlook) -> dict[str, Any]:
    """Return how jobs come along for programs."""
    return {"jobs_per_minute": outlook.per_minute, "estimate": outlook.estimate}


def outlook_text(outlook: Outlook) -> str:
    """Say how fast jobs come along, and when the rest will have ended."""
    rate = "" if outlook.per_minute is None else f"{outlook.per_minute:.3g} jobs/min, "
    return rate + estimate_text(outlook.estimate, datetime.now(UTC))


def estimate_text(estimate: Estimate, now: datetime) -> str:
    """Say when jobs will have ended, and what that depends on."""
    where = f"on {number_of(estimate.workers, 'worker')}" + ("" if estimate.alive else " once 'sms up' runs")
    new = ", ".join(f"{kind} ({count})" for kind, count in estimate.unknown.items())
    if estimate.jobs and estimate.reused == estimate.jobs:
        return f"nothing has to be computed: {estimate.jobs} of {estimate.jobs} are reused"
    if estimate.unserved:
        say = f"no end in sight: {_unserved(estimate)}"
    elif estimate.seconds is None or estimate.ready_at is None:
        say = f"no estimate: there is no history yet of {new}"
        say += "" if estimate.alive else f"; {_NO_WORKER}"
    else:
        span = duration(estimate.seconds)
        ready = clock(estimate.ready_at, now)
        if new:
            say = f"at least {span} {where}, not before {ready}; there is no history yet of {new}"
        else:
            say = f"about {span} {where}" + (f"; ready {ready}" if estimate.alive else "")
    if estimate.reused:
        say += f"; {estimate.reused} of {estimate.jobs} are reused"
    if estimate.looked_at is not None:
        say += f"; roughly, from a sample of {estimate.looked_at} of the jobs, as if none could be reused"
    if estimate.paused:
        say += f"; paused: {', '.join(estimate.paused)}"
    return say
