"""How long jobs will take, from how long such jobs have taken here before."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from math import isfinite
from statistics import fmean
from typing import TYPE_CHECKING

from sqlalchemy import and_, exists, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import QueueRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.planning.coming import Coming, Graph, Sample, coming, coming_with, running
from sms_jobs.jobs.planning.foreseen import foreseen_reuse
from sms_jobs.jobs.planning.history import History
from sms_jobs.jobs.planning.makespan import Places, Task, makespan, shared
from sms_jobs.kinds.kind import Queue
from sms_jobs.records.job import ACTIVE, ALIVE_WITHIN, JobState
from sms_jobs.records.shown.estimates import Estimate, Outlook

if TYPE_CHECKING:
    from sms_jobs.jobs.planning.submission import Draft

_PACE_OVER = timedelta(minutes=10)
_BELIEVED_PROGRESS = 0.05
"""From here on the progress of a running job tells how long it will take where nothing else does."""


def estimate(session: Session, chosen: Chosen, now: datetime, workers_if_started: int) -> Estimate:
    """Estimate when some jobs will have ended.

    What each takes is the median of the jobs that are most like it: of the same parameters, size, host and
    version, in this order, as far as there are such; other sizes are scaled. Jobs that come before these take
    their share of the workers too. `makespan` says how the parts add up. Where these are very many, a
    sample tells what each takes, and the work is shared by all who can do it.

    Parameters
    ----------
    workers_if_started
        Counted on where no worker is alive.
    """
    return _estimate(session, coming(session, chosen), None, now, workers_if_started)


def estimate_planned(session: Session, planned: Draft, now: datetime, workers_if_started: int) -> Estimate:
    """Estimate when jobs would have ended that are about to be submitted."""
    return _estimate(session, coming_with(session, planned), planned, now, workers_if_started)


def _estimate(
    session: Session,
    work: Graph | Sample,
    planned: Draft | None,
    now: datetime,
    workers_if_started: int,
) -> Estimate:
    places, hosts = _workers(session, now)
    alive = bool(places)
    if not alive:
        places = [Places(frozenset(q.value for q in Queue), workers_if_started)]
    history = History(session, hosts, work.by_frames, work.jobs)
    if isinstance(work, Graph):
        drafted = set() if planned is None else set(planned.job_ids)
        entered = [job.id for job in work.jobs if job.id not in drafted]
        foreseen = foreseen_reuse(session, entered, planned)
        totals = _of_graph(work, foreseen, history, places, now)
    else:
        totals = _of_sample(work, history, places, now)
    seconds: float | None = totals.seconds
    if not isfinite(seconds or 0.0) or (
        totals.unknown and totals.unknown.total() + totals.reused >= totals.jobs
    ):
        seconds = None
    served = frozenset[str]().union(*(p.queues for p in places))
    return Estimate(
        jobs=totals.jobs,
        reused=totals.reused,
        seconds=seconds,
        ready_at=None if seconds is None else now + timedelta(seconds=seconds),
        workers=sum(p.count for p in places),
        alive=alive,
        unknown=dict(sorted(totals.unknown.items())),
        unserved=tuple(sorted(totals.queues - served)),
        paused=tuple(sorted(totals.queues & _paused(session))),
        looked_at=totals.looked_at,
    )


@dataclass(frozen=True)
class _Totals:
    """What the requested jobs add up to, before it is known who serves their queues."""

    jobs: int
    reused: int
    seconds: float
    unknown: Counter[str]
    queues: frozenset[str]
    looked_at: int | None = None


def _of_graph(
    work: Graph, foreseen: Collection[str], history: History, places: Sequence[Places], now: datetime
) -> _Totals:
    place = {job.id: n for n, job in enumerate(work.jobs)}
    tasks, unknown = [], Counter[str]()
    for job in work.jobs:
        left = 0.0 if job.id in foreseen else _left(job, history.seconds(job), now)
        if left is None and job.requested:
            unknown[job.kind] += 1
        needs = tuple(place[n] for n in work.needs[job.id])
        tasks.append(Task(left or 0.0, job.queue, needs, requested=job.requested))
    requested = [job for job in work.jobs if job.requested]
    reused = sum(job.id in foreseen for job in requested)
    queues = frozenset(job.queue for job in requested)
    return _Totals(len(requested), reused, makespan(tasks, places), unknown, queues)


def _of_sample(work: Sample, history: History, places: Sequence[Places], now: datetime) -> _Totals:
    by_queue: dict[str, list[float]] = defaultdict(list)
    unknown_here: dict[str, Counter[str]] = defaultdict(Counter)
    for job in work.jobs:
        left = _left(job, history.seconds(job), now)
        by_queue[job.queue].append(left or 0.0)
        if left is None:
            unknown_here[job.queue][job.kind] += 1
    seconds = {
        queue: count * fmean(by_queue[queue]) if by_queue[queue] else 0.0
        for queue, count in work.total.items()
    }
    unknown = Counter[str]()
    for queue, kinds in unknown_here.items():
        for kind, count in kinds.items():
            unknown[kind] += round(work.requested.get(queue, 0) * count / len(by_queue[queue]))
    queues = frozenset(queue for queue, count in work.requested.items() if count)
    return _Totals(
        sum(work.requested.values()), 0, shared(seconds, queues, places), +unknown, queues, len(work.jobs)
    )


def outlook(session: Session, chosen: Chosen, workers: int) -> Outlook:
    """Return how some jobs come along; `workers` are counted on where none is alive."""
    now = datetime.now(UTC)
    return Outlook(pace(session, chosen, now), estimate(session, chosen, now, workers))


def ends(session: Session, now: datetime, at_most: int) -> dict[str, datetime]:
    """Return when the jobs that run will have ended, by id; without those of which nothing tells."""
    work = running(session, at_most)
    if not work.jobs:
        return {}
    history = History(session, _workers(session, now)[1], work.by_frames, work.jobs)
    left = {job.id: _left(job, history.seconds(job), now) for job in work.jobs if job.requested}
    return {name: now + timedelta(seconds=seconds) for name, seconds in left.items() if seconds is not None}


def pace(session: Session, chosen: Chosen, now: datetime) -> float | None:
    """Return how many of some jobs end in a minute, measured over the last ten; None before one has.

    Jobs that were reused or never ran say nothing of how fast the others are and do not count.
    """
    since = now - _PACE_OVER
    ran = (*chosen.where, JobRow.started_at.is_not(None), JobRow.reused_from.is_(None))
    lately = and_(JobRow.finished_at >= since, JobRow.state.not_in(ACTIVE))
    ended = session.scalar(select(func.count()).where(*ran, lately))
    if not ended:
        return None
    # Whether any began before is soon found where there is one.
    if session.scalar(select(exists().where(*ran, JobRow.started_at <= since))):
        begun = since
    else:
        begun = session.scalar(select(func.min(JobRow.started_at)).where(*ran)) or now
    minutes = (now - begun).total_seconds() / 60.0
    return float(ended / minutes) if minutes > 0.0 else None


def _workers(session: Session, now: datetime) -> tuple[list[Places], set[str]]:
    """Return what the workers that live can run at once, and their hosts."""
    rows = session.execute(
        select(WorkerRow.queues, WorkerRow.concurrency, WorkerRow.host).where(
            WorkerRow.beat_at >= now - ALIVE_WITHIN, WorkerRow.draining.is_(False)
        )
    ).all()
    return [Places(frozenset(row.queues.split(",")), row.concurrency) for row in rows], {r.host for r in rows}


def _paused(session: Session) -> set[str]:
    return set(session.scalars(select(QueueRow.name).where(QueueRow.paused_at.is_not(None))))


def _left(job: Coming, seconds: float | None, now: datetime) -> float | None:
    """Return what a job takes from now on, given what it takes in all; None where nothing tells."""
    if job.state is not JobState.RUNNING or job.started_at is None:
        return seconds
    elapsed = max(float((now - job.started_at).total_seconds()), 0.0)
    if seconds is not None and elapsed < seconds:
        return seconds - elapsed
    if job.progress >= _BELIEVED_PROGRESS:
        return float(elapsed * (1.0 - job.progress) / job.progress)
    return None if seconds is None else 0.0
