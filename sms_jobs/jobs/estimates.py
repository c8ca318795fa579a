"""How long jobs will take, from how long such jobs have taken here before."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from graphlib import TopologicalSorter
from math import isfinite
from statistics import median
from typing import Any

from pydantic import TypeAdapter
from sqlalchemy import Row, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import (
    CampaignRow,
    DependencyRow,
    JobRow,
    LoadStateRow,
    QueueRow,
    SensorRow,
    WorkerRow,
)
from sms_jobs.jobs.foreseen import foreseen_reuse
from sms_jobs.jobs.makespan import Places, Task, makespan
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Queue
from sms_jobs.records.campaign import Subject
from sms_jobs.records.job import ACTIVE, ALIVE_WITHIN, JobState
from sms_jobs.records.measurement import FringeSequence

_PACE_OVER = timedelta(minutes=10)
_REMEMBERED = 200
"""Jobs of a kind, the latest, that an estimate looks back on."""
_SEQUENCE = TypeAdapter(FringeSequence)
_BELIEVED_PROGRESS = 0.05
"""From here on the progress of a running job tells how long it will take where nothing else does."""


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


@dataclass(frozen=True)
class _Size:
    """What the work of a job grows with: pixels of all its pairs and states, and frames of each."""

    pixels: int
    frames: int


@dataclass(frozen=True)
class _Past:
    """A job that has succeeded, and what it took."""

    version: int
    parameters: dict[str, Any]
    size: _Size | None
    host: str
    seconds: float


def estimate(session: Session, job_ids: Sequence[str], now: datetime, workers_if_started: int) -> Estimate:
    """Estimate when some jobs will have ended.

    What each takes is the median of the jobs that are most like it: of the same parameters, size, host and
    version, in this order, as far as there are such; other sizes are scaled. Jobs that come before these take
    their share of the workers too. How the parts add up is told by `makespan`.

    Parameters
    ----------
    workers_if_started
        Counted on where no worker is alive.
    """
    places, hosts = _workers(session, now)
    alive = bool(places)
    if not alive:
        places = [Places(frozenset(q.value for q in Queue), workers_if_started)]
    wanted = set(job_ids)
    jobs, needs, by_frames = _coming(session, wanted)
    foreseen = foreseen_reuse(session, [job.id for job in jobs])
    history = _History(session, hosts, by_frames)
    place = {job.id: n for n, job in enumerate(jobs)}
    tasks, unknown = [], Counter[str]()
    for job in jobs:
        left = 0.0 if job.id in foreseen else _left(job, history.seconds(job), now)
        if left is None and job.id in wanted:
            unknown[job.kind] += 1
        tasks.append(
            Task(left or 0.0, job.queue, tuple(place[n] for n in needs[job.id]), wanted=job.id in wanted)
        )
    reused = len(foreseen & wanted)
    count = sum(task.wanted for task in tasks)
    seconds: float | None = makespan(tasks, places)
    if not isfinite(seconds or 0.0) or (unknown and unknown.total() + reused == count):
        seconds = None
    queues = {task.queue for task in tasks if task.wanted}
    return Estimate(
        jobs=count,
        reused=reused,
        seconds=seconds,
        ready_at=None if seconds is None else now + timedelta(seconds=seconds),
        workers=sum(p.count for p in places),
        alive=alive,
        unknown=dict(sorted(unknown.items())),
        unserved=tuple(sorted(queues - frozenset[str]().union(*(p.queues for p in places)))),
        paused=tuple(sorted(queues & _paused(session))),
    )


def pace(session: Session, job_ids: Sequence[str], now: datetime) -> float | None:
    """Return how many of some jobs end in a minute, measured over the last ten; None before one has.

    Jobs that were reused or never ran say nothing of how fast the others are and do not count.
    """
    since = now - _PACE_OVER
    ran = (JobRow.started_at.is_not(None), JobRow.reused_from.is_(None))
    begun, ended = session.execute(
        select(
            func.min(JobRow.started_at),
            func.count().filter(JobRow.finished_at >= since, JobRow.state.not_in(ACTIVE)),
        ).where(JobRow.id.in_(job_ids), *ran)
    ).one()
    if begun is None or not ended:
        return None
    minutes = (now - max(begun, since)).total_seconds() / 60.0
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


def _coming(
    session: Session, wanted: Collection[str]
) -> tuple[list[Row[Any]], Mapping[str, list[str]], set[str]]:
    """Return the active jobs that are wanted or come before those, what each needs, and kinds of frames.

    Each comes after what it needs. The kinds are those that work on measurements alone, and so on frames:
    what takes results of others has one image of each pair to go through.
    """
    rows = session.execute(
        select(
            JobRow.id,
            JobRow.kind,
            JobRow.kind_version,
            JobRow.campaign_id,
            JobRow.subject,
            JobRow.parameters,
            JobRow.queue,
            JobRow.state,
            JobRow.started_at,
            JobRow.progress,
            JobRow.priority,
            JobRow.position,
        ).where(JobRow.state.in_(ACTIVE))
    ).all()
    by_id = {row.id: row for row in rows}
    edges = session.execute(
        select(DependencyRow.job_id, DependencyRow.producer_id, DependencyRow.source).where(
            DependencyRow.job_id.in_(select(JobRow.id).where(JobRow.state.in_(ACTIVE)))
        )
    )
    needs: dict[str, list[str]] = defaultdict(list)
    sources: dict[str, set[str]] = defaultdict(set)
    for job_id, producer, source in edges:
        if producer is not None and producer in by_id:
            needs[job_id].append(producer)
        sources[by_id[job_id].kind].add(source)
    last = max(((-row.priority, row.position) for row in rows if row.id in wanted), default=None)
    chosen = set() if last is None else {r.id for r in rows if (-r.priority, r.position) <= last}
    pending = [row.id for row in rows if row.id in wanted]
    while pending:
        found = set(needs[pending.pop()]) - chosen
        chosen |= found
        pending += found
    order = TopologicalSorter({job_id: needs[job_id] for job_id in by_id if job_id in chosen})
    kinds = {row.kind for row in rows}
    by_frames = {kind for kind in kinds if sources[kind] <= {MEASUREMENT, CALIBRATION}}
    return [by_id[job_id] for job_id in order.static_order()], needs, by_frames


def _left(job: Row[Any], seconds: float | None, now: datetime) -> float | None:
    """Return what a job takes from now on, given what it takes in all; None where nothing tells."""
    if job.state is not JobState.RUNNING or job.started_at is None:
        return seconds
    elapsed = max(float((now - job.started_at).total_seconds()), 0.0)
    if seconds is not None and elapsed < seconds:
        return seconds - elapsed
    if job.progress >= _BELIEVED_PROGRESS:
        return float(elapsed * (1.0 - job.progress) / job.progress)
    return None if seconds is None else 0.0


class _History:
    """What jobs of a kind have taken before."""

    def __init__(self, session: Session, hosts: Collection[str], by_frames: Collection[str]) -> None:
        self._session = session
        self._hosts = hosts
        self._by_frames = by_frames
        self._past: dict[str, list[_Past]] = {}
        self._campaigns: dict[int, _Images | None] = {}
        self._told: dict[tuple[Any, ...], float | None] = {}

    def seconds(self, job: Row[Any]) -> float | None:
        """Return the median of the jobs that are most like this one; None where its kind has never run."""
        size = self._size(job.kind, job.campaign_id, job.subject)
        key = (job.kind, job.kind_version, str(job.parameters), size)
        if key not in self._told:
            self._told[key] = self._median(job, size)
        return self._told[key]

    def _median(self, job: Row[Any], size: _Size | None) -> float | None:
        by_likeness: dict[tuple[bool, ...], list[float]] = defaultdict(list)
        for past in self._of_kind(job.kind):
            alike = (
                past.parameters == job.parameters,
                past.size == size,
                past.host in self._hosts,
                past.version == job.kind_version,
            )
            by_likeness[alike].append(past.seconds * self._ratio(job.kind, size, past.size))
        return median(by_likeness[max(by_likeness)]) if by_likeness else None

    def _ratio(self, kind: str, size: _Size | None, past: _Size | None) -> float:
        if size is None or past is None:
            return 1.0
        frames = size.frames / past.frames if kind in self._by_frames else 1.0
        return size.pixels / past.pixels * frames

    def _of_kind(self, kind: str) -> list[_Past]:
        if kind not in self._past:
            rows = self._session.execute(
                select(
                    JobRow.kind_version,
                    JobRow.parameters,
                    JobRow.campaign_id,
                    JobRow.subject,
                    WorkerRow.host,
                    JobRow.started_at,
                    JobRow.finished_at,
                )
                .join(WorkerRow, WorkerRow.id == JobRow.worker_id)
                .where(
                    JobRow.kind == kind,
                    JobRow.state == JobState.SUCCEEDED,
                    JobRow.reused_from.is_(None),
                    JobRow.started_at.is_not(None),
                )
                .order_by(JobRow.finished_at.desc())
                .limit(_REMEMBERED)
            )
            self._past[kind] = [
                _Past(version, parameters, self._size(kind, campaign, subject), host, _between(begun, ended))
                for version, parameters, campaign, subject, host, begun, ended in rows
            ]
        return self._past[kind]

    def _size(self, kind: str, campaign_id: int, subject: str) -> _Size | None:
        if campaign_id not in self._campaigns:
            self._campaigns[campaign_id] = _images(self._session, campaign_id)
        images = self._campaigns[campaign_id]
        return None if images is None else images.size(Subject.parse(subject))


@dataclass(frozen=True)
class _Images:
    """The images of a campaign: pixels of a pair's camera, frames of a measurement, number of states."""

    pixels: Mapping[str, int]
    frames: int
    states: int

    def size(self, subject: Subject) -> _Size | None:
        if subject.pair is not None:
            pixels = self.pixels.get(subject.pair, 0)
        else:
            pixels = sum(self.pixels.values()) * (self.states if subject.state is None else 1)
        return _Size(pixels, self.frames) if pixels and self.frames else None


def _images(session: Session, campaign_id: int) -> _Images | None:
    definition = CampaignRow.definition
    row = session.execute(
        select(CampaignRow.rig_id, definition["pairs"], definition["sequence"]).where(
            CampaignRow.id == campaign_id
        )
    ).one_or_none()
    if row is None:
        return None
    rig_id, pairs, sequence = row
    cameras = session.execute(
        select(SensorRow.name, SensorRow.columns * SensorRow.rows).where(SensorRow.rig_id == rig_id)
    )
    pixels = dict(cameras.all())
    states = session.scalar(select(func.count()).where(LoadStateRow.campaign_id == campaign_id)) or 0
    frames = _SEQUENCE.validate_python(sequence).frames
    # A campaign of images alone has cameras in place of pairs.
    return _Images({pair: pixels.get(pair.partition("P")[0], 0) for pair in pairs}, frames, states)


def _between(begun: datetime | None, ended: datetime | None) -> float:
    # A clock that was set back makes no job end before it began.
    return max((ended - begun).total_seconds(), 0.0) if begun and ended else 0.0
