"""No input ends in an internal error: hostile command lines and files, on both databases."""

from __future__ import annotations

import os
from collections.abc import Iterator

from sms_jobs.bench.figures import Condition, Figure, Found, Run
from sms_jobs.bench.hostile.campaign import Deployment, tried
from sms_jobs.bench.hostile.trial import BATCH
from sms_jobs.bench.promises import Promise
from sms_jobs.bench.servers import POSTGRESQL

SEED = 15
_TRIES = 2000
_QUICK_TRIES = 200


def measure(run: Run) -> Iterator[Found]:
    """Yield how many hostile inputs were tried, and how many did what none may do."""
    deployments: tuple[Deployment, ...] = (
        ("embedded", "grown") if os.environ.get(POSTGRESQL) else ("embedded",)
    )
    batches = (_QUICK_TRIES if run.quick else _TRIES) // BATCH // len(deployments)
    count = faults = 0
    for deployment in deployments:
        run.say(f"promises: hostile input, {deployment}")
        folder = run.folder / f"hostile-{deployment}"
        folder.mkdir()
        for outcome in tried(folder, deployment, SEED, range(batches)):
            count += 1
            faults += bool(outcome.faults)
            if outcome.faults:
                run.say(f"{outcome.faults[0]}: {' '.join(outcome.arguments)[:300]!r} {outcome.environment}")
    yield Figure("hostile_inputs", float(count), "1", None if run.quick else 2000.0, "at least")
    yield Figure("hostile_internal_errors", float(faults), "1", 0.0, "at most")
    yield Condition(
        "hostile",
        f"{count} command lines from the table of commands, seed {SEED}, {' and '.join(deployments)}: none "
        "may end in an internal error, take 10 CPU-seconds, leave anything half done, tell a password or "
        "print an escape sequence",
    )


PROMISE = Promise("hostile", measure)
