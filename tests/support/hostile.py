"""Hostile input in its short form, which every run of the tests has, and in its long form."""

from __future__ import annotations

from pathlib import Path

from sms_jobs.bench.hostile.campaign import Deployment, tried
from sms_jobs.bench.hostile.trial import BATCH
from sms_jobs.bench.promises.hostile import SEED

SHORT_BATCHES: dict[Deployment, range] = {"embedded": range(20), "grown": range(20, 40)}
LONG_BATCHES = range(500)
"""Of both databases together 2,000 tries, no two alike, and 50,000; `sms bench promises` makes 2,000."""


def assert_well(folder: Path, deployment: Deployment, batches: range) -> None:
    """Try batches of hostile command lines; fail with those that did what none may do."""
    outcomes = list(tried(folder, deployment, SEED, batches))
    bad = [
        f"seed {SEED}, batch {o.batch}, try {o.number}: {'; '.join(o.faults)}\n"
        f"  sms {' '.join(map(repr, o.arguments))[:1000]}\n  {o.environment}\n  {o.said[-500:]}"
        for o in outcomes
        if o.faults
    ]
    assert not bad, "\n".join(bad)
    assert len(outcomes) == BATCH * len(batches)
    # Not everything is refused: what is taken is tried too.
    assert sum(o.code == 0 for o in outcomes) > len(outcomes) // 10
