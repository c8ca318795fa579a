"""Shows how jobs come along, how fast, and when they will have ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from sms_jobs.cli import output
from sms_jobs.cli.output import clock, duration
from sms_jobs.records.shown.estimates import Estimate, Outlook

if TYPE_CHECKING:
    from sms_jobs.app.work.waiting import Waiting


@contextmanager
def followed(stop: str = "") -> Iterator[Callable[[Waiting], None]]:
    """Show on a bar how the jobs come along that are waited for.

    Where there is no terminal for it, say what would never end: that no worker serves their queue. Who
    interrupts the waiting is told that the jobs go on, and which command, `stop`, ends them, if it is given.
    """
    from sms_jobs.cli.bars import job_bar

    with job_bar() as bar:
        task = bar.add_task("jobs", total=None, pace="")
        said: set[str] = set()

        def tell(now: Waiting) -> None:
            bar.update(
                task,
                total=now.total,
                completed=now.total - now.active,
                description=now.running or "jobs",
                pace="" if now.outlook is None else outlook_text(now.outlook),
            )
            queues = ", ".join(now.outlook.estimate.unserved) if now.outlook is not None else ""
            if bar.disable and queues and queues not in said:
                said.add(queues)
                output.say(f"waiting, with no end in sight: no worker serves the queue {queues}")

        try:
            yield tell
        except KeyboardInterrupt:
            if stop:
                output.say(f"what was submitted goes on: 'sms job list' shows it, and '{stop}' stops it")
            raise


def as_json(outlook: Outlook) -> dict[str, Any]:
    """Return how jobs come along for programs."""
    return {"jobs_per_minute": outlook.per_minute, "estimate": outlook.estimate}


def outlook_text(outlook: Outlook) -> str:
    """Say how fast jobs come along, and when the rest will have ended."""
    rate = "" if outlook.per_minute is None else f"{outlook.per_minute:.3g} jobs/min, "
    return rate + estimate_text(outlook.estimate, datetime.now(UTC))


def estimate_text(estimate: Estimate, now: datetime) -> str:
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
        say += "" if estimate.alive else "; no worker is there: start one with 'sms up'"
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
