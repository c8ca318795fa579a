"""Which jobs are still to be done before some have ended, and what each of them needs."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from graphlib import TopologicalSorter
from typing import TYPE_CHECKING, Any

from sqlalchemy import ColumnElement, Row, Select, and_, false, func, or_, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import job_counts
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.records.job import ACTIVE, JobState

if TYPE_CHECKING:
    from sms_jobs.jobs.planning.submission import Draft

MOST = 2000
"""Jobs of the catalogue that are looked at one by one; of more a sample is."""
_SAMPLE = 200
_PLANNED = ("id", "kind", "kind_version", "campaign_id", "subject", "parameters", "queue", "state")
_Edge = tuple[str, str | None, str]
_IDS = 16**16
"""Ids of jobs are that many random numbers, in hexadecimal digits."""


@dataclass(frozen=True)
class Coming:
    """A job that has not ended, or is about to be submitted."""

    id: str
    kind: str
    kind_version: int
    campaign_id: int
    subject: str
    parameters: dict[str, Any]
    queue: str
    state: JobState
    started_at: datetime | None
    progress: float
    requested: bool


@dataclass(frozen=True)
class Graph:
    """Jobs, each after those that it needs.

    Attributes
    ----------
    jobs, needs
        The jobs, and by id the jobs among them that it needs.
    by_frames
        Kinds that work on measurements alone, and so on frames: what takes results of others has one image
        of each view to go through.
    """

    jobs: tuple[Coming, ...]
    needs: Mapping[str, Sequence[str]]
    by_frames: frozenset[str]


@dataclass(frozen=True)
class Sample:
    """Some of many jobs, taken by chance, and how many there are of each queue.

    Attributes
    ----------
    jobs
        The sample.
    total, requested
        Number of all jobs, and of the requested ones, by queue.
    by_frames
        As of a graph.
    """

    jobs: tuple[Coming, ...]
    total: Mapping[str, int]
    requested: Mapping[str, int]
    by_frames: frozenset[str]


def coming(session: Session, chosen: Chosen) -> Graph | Sample:
    """Return the active jobs that were asked for and those that come before them; of very many, a sample."""
    requested = and_(JobRow.state.in_(ACTIVE), *chosen.where)
    before = _before(session, requested) if chosen.where else requested
    if before is None:
        return Graph((), {}, frozenset())
    if not _are_few(session, before):
        total = _by_queue(session, before) if chosen.where else _active_by_queue(session)
        return _sample(
            session, before, requested, total, _by_queue(session, requested) if chosen.where else total
        )
    jobs = [_coming(row) for row in session.execute(_query(requested).where(before))]
    return _closed(session, jobs, _edges(session, before), requested)


def running(session: Session, at_most: int) -> Graph:
    """Return jobs that run, those that began last, and what they still need."""
    began_last = select(JobRow.id).where(JobRow.state == JobState.RUNNING).order_by(JobRow.started_at.desc())
    ids = session.scalars(began_last.limit(at_most)).all()
    if not ids:
        return Graph((), {}, frozenset())
    these = JobRow.id.in_(ids)
    jobs = [_coming(row) for row in session.execute(_query(these).where(these))]
    return _closed(session, jobs, _edges(session, these), these)


def coming_with(session: Session, planned: Draft) -> Graph | Sample:
    """Return jobs that are about to be submitted, and the active ones that come before them."""
    rows = planned.of(JobRow)
    if not rows:
        return Graph((), {}, frozenset())
    mine = [
        Coming(**{name: row[name] for name in _PLANNED}, started_at=None, progress=0.0, requested=True)
        for row in rows
    ]
    nobody = false()
    before = _not_after(rows[-1]["priority"], rows[-1]["position"])
    if not _are_few(session, before):
        added = Counter(job.queue for job in mine)
        total = Counter(_by_queue(session, before)) + added
        return _sample(session, before, nobody, total, added, mine)
    edges = [(e["job_id"], e["producer_id"], e["source"]) for e in planned.of(DependencyRow)]
    jobs = [_coming(row) for row in session.execute(_query(nobody).where(before))]
    return _closed(session, [*jobs, *mine], [*_edges(session, before), *edges], nobody)


def _before(session: Session, requested: ColumnElement[bool]) -> ColumnElement[bool] | None:
    """Select the active jobs that were asked for or come before the last of those; None without any."""
    # In one statement: between two the last of them may end.
    last = session.execute(
        select(JobRow.priority, JobRow.position)
        .where(requested)
        .order_by(JobRow.priority, JobRow.position.desc())
        .limit(1)
    ).one_or_none()
    return None if last is None else _not_after(last.priority, last.position)


def _not_after(priority: int, position: int) -> ColumnElement[bool]:
    return and_(
        JobRow.state.in_(ACTIVE),
        or_(JobRow.priority > priority, and_(JobRow.priority == priority, JobRow.position <= position)),
    )


def _are_few(session: Session, which: ColumnElement[bool]) -> bool:
    # The index of what comes next has the position and not the id, for which all jobs would be read.
    some = select(JobRow.position).where(which).limit(MOST + 1).subquery()
    return (session.scalar(select(func.count()).select_from(some)) or 0) <= MOST


def _query(requested: ColumnElement[bool]) -> Select[Any]:
    columns = [getattr(JobRow, name) for name in (*_PLANNED, "started_at", "progress")]
    return select(*columns, requested.label("requested"))


def _coming(row: Row[Any]) -> Coming:
    return Coming(**{**row._mapping, "requested": bool(row.requested)})


def _edges(session: Session, which: ColumnElement[bool]) -> list[_Edge]:
    """Return what some jobs need: job, producer, source."""
    edge = DependencyRow
    rows = session.execute(
        select(edge.job_id, edge.producer_id, edge.source).join(JobRow, JobRow.id == edge.job_id).where(which)
    )
    return [(job_id, producer, source) for job_id, producer, source in rows]


def _closed(
    session: Session, jobs: Sequence[Coming], edges: Sequence[_Edge], requested: ColumnElement[bool]
) -> Graph:
    """Put jobs in order, with the active ones that they need and that would be claimed after them."""
    by_id = {job.id: job for job in jobs}
    all_edges, found = list(edges), set(by_id)
    while missing := sorted({p for _, p, _ in all_edges if p is not None} - found):
        found.update(missing)
        for names in parts(missing):
            some = and_(JobRow.id.in_(names), JobRow.state.in_(ACTIVE))
            by_id |= {row.id: _coming(row) for row in session.execute(_query(requested).where(some))}
            all_edges += _edges(session, some)
    needs: dict[str, list[str]] = {job_id: [] for job_id in by_id}
    sources: dict[str, set[str]] = defaultdict(set)
    for job_id, producer, source in all_edges:
        if producer in by_id:
            needs[job_id].append(producer)
        sources[by_id[job_id].kind].add(source)
    order = TopologicalSorter(needs).static_order()
    return Graph(tuple(by_id[job_id] for job_id in order), needs, _by_frames(sources))


def _by_frames(sources: Mapping[str, set[str]]) -> frozenset[str]:
    return frozenset(kind for kind, some in sources.items() if some <= {MEASUREMENT, CALIBRATION})


def _active_by_queue(session: Session) -> dict[str, int]:
    counted = job_counts.counted(session, JobCountRow.queue, states=ACTIVE)
    return {queue: count for (queue,), count in counted.items()}


def _by_queue(session: Session, which: ColumnElement[bool]) -> dict[str, int]:
    query = select(JobRow.queue, func.count()).where(which).group_by(JobRow.queue)
    return dict(session.execute(query).all())


def _sample(
    session: Session,
    which: ColumnElement[bool],
    requested: ColumnElement[bool],
    total: Mapping[str, int],
    requested_by_queue: Mapping[str, int],
    further: Sequence[Coming] = (),
) -> Sample:
    """Take a sample of each queue, since one may hold few jobs that take long."""
    jobs: dict[str, Coming] = {}
    edges: list[_Edge] = []
    for queue, count in total.items():
        of_queue = and_(which, JobRow.queue == queue)
        # Ids are random: those below a bound are a random sample. SQLite takes the index of ids, which leads
        # to few, rather than that of states for a range alone.
        bound = f"{int(min(1.0, _SAMPLE / count) * (_IDS - 1)):016x}"
        some = [
            _coming(row)
            for row in session.execute(_query(requested).where(of_queue, JobRow.id.between("", bound)))
        ]
        jobs |= {job.id: job for job in some}
    for ids in parts(list(jobs)):
        edges += _edges(session, JobRow.id.in_(ids))
    sources: dict[str, set[str]] = defaultdict(set)
    for job_id, _, source in edges:
        sources[jobs[job_id].kind].add(source)
    every = max(1, len(further) // _SAMPLE)
    return Sample((*jobs.values(), *further[::every]), total, requested_by_queue, _by_frames(sources))
