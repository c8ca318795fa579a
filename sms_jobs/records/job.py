"""The states of a job and the changes between them that are allowed."""

from __future__ import annotations

from datetime import timedelta
from enum import Enum


class JobState(Enum):
    """Where a job stands in its life."""

    WAITING = "waiting"
    """For the jobs whose results it needs."""
    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    SKIPPED = "skipped"
    """Something it needs failed or was cancelled, so it never ran."""
    CANCELLED = "cancelled"
    LOST = "lost"
    """Its worker vanished; the reconciler decides what becomes of it."""
    QUARANTINED = "quarantined"
    """Its worker vanished too often: running it again may bring down another."""
    NEEDS_OPERATOR = "needs-operator"
    """It was interrupted, or an instrument gave up, and must not go on without a person's word."""


TRANSITIONS: dict[JobState, frozenset[JobState]] = {
    JobState.WAITING: frozenset({JobState.QUEUED, JobState.SKIPPED, JobState.CANCELLED}),
    JobState.QUEUED: frozenset({JobState.RUNNING, JobState.CANCELLED}),
    JobState.RUNNING: frozenset(
        {
            JobState.SUCCEEDED,
            JobState.FAILED,
            JobState.CANCELLED,
            JobState.LOST,
            JobState.QUEUED,
            JobState.NEEDS_OPERATOR,
        }
    ),
    JobState.LOST: frozenset(
        {
            JobState.QUEUED,
            JobState.QUARANTINED,
            JobState.NEEDS_OPERATOR,
            JobState.CANCELLED,
            JobState.FAILED,
        }
    ),
    JobState.SUCCEEDED: frozenset(),
    JobState.FAILED: frozenset({JobState.WAITING, JobState.QUEUED}),
    JobState.SKIPPED: frozenset({JobState.WAITING}),
    JobState.CANCELLED: frozenset({JobState.WAITING, JobState.QUEUED}),
    JobState.QUARANTINED: frozenset({JobState.QUEUED, JobState.CANCELLED}),
    JobState.NEEDS_OPERATOR: frozenset({JobState.QUEUED, JobState.CANCELLED}),
}
"""To which states a job may go from each; running -> queued is a retry after a passing fault."""

ACTIVE = frozenset({JobState.WAITING, JobState.QUEUED, JobState.RUNNING, JobState.LOST})
"""States that change by themselves: somebody who waits for a job waits while it is in one of them."""

UNSUCCESSFUL = frozenset(
    {
        JobState.FAILED,
        JobState.SKIPPED,
        JobState.CANCELLED,
        JobState.QUARANTINED,
        JobState.NEEDS_OPERATOR,
    }
)

ALIVE_WITHIN = timedelta(seconds=60)
"""A worker whose last sign of life is older counts as dead."""


SHORT_ID = 8
"""Characters of a job id that are shown; a unique prefix is enough to name a job."""


def origins(target: JobState) -> tuple[JobState, ...]:
    """Return the states from which a job may go to `target`."""
    return tuple(state for state, targets in TRANSITIONS.items() if target in targets)
