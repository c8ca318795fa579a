"""What the service promises: kills, damaged files, crowds and hostile input, counted."""

from __future__ import annotations

from collections.abc import Iterator

from sms_jobs.bench.figures import Found, Group, Run
from sms_jobs.bench.promises import all_promises


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures of every promise, and their conditions."""
    for promise in all_promises().values():
        yield from promise.measure(run)


GROUP = Group("promises", "kills, damaged files, crowds and hostile input", lambda: None, measure)
