"""How long jobs will take, and how fast they come along."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class Estimate:
    """When jobs will have ended.

    Attributes
    ----------
    jobs
        That have not ended yet.
    reused
        Of these, those that are known beforehand to be reused: they count as nothing.
    seconds
        Until the last has ended; None where nothing is known, or nobody serves a queue of them.
    ready_at
        The same as a time.
    workers
        Jobs that run at the same time.
    alive
        Whether these workers are there; otherwise they would be once the service is started here.
    unknown
        Number of jobs of each kind that has never run here; they count as nothing, so that it takes longer.
    unserved
        Queues that no worker serves.
    paused
        Queues that are held back; the time counts from when they go on.
    looked_at
        Of very many jobs some alone are looked at: so many. What will be reused is then not known, nor what
        waits for what; None where all were.
    """

    jobs: int
    reused: int
    seconds: float | None
    ready_at: datetime | None
    workers: int
    alive: bool
    unknown: Mapping[str, int]
    unserved: tuple[str, ...]
    paused: tuple[str, ...]
    looked_at: int | None = None


@dataclass(frozen=True)
class Outlook:
    """How fast jobs come along, and when the rest will have ended."""

    per_minute: float | None
    estimate: Estimate
