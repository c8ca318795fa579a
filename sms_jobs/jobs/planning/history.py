"""How long jobs of a kind have taken here before."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import median
from typing import Any, NamedTuple, TypeAlias

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import valid_calibrations
from sms_jobs.catalogue.campaigns import number_of_states
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.planning.coming import Coming
from sms_jobs.records.job import JobState
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

_REMEMBERED = 200
"""Jobs of a kind, the latest, that an estimate looks back on."""
_LATEST_FIRST = JobRow.finished_at.desc()
_Latest: TypeAlias = tuple[str, datetime | None]
"""Id of a job, and when it ended."""


@dataclass(frozen=True)
class _Size:
    """What the work of a job grows with: pixels of all its views and states, and frames of each."""

    pixels: int
    frames: int


@dataclass(frozen=True)
class _Done:
    """A job that has succeeded, and what it took."""

    version: int
    parameters: dict[str, Any]
    campaign_id: int
    subject: str
    host: str
    seconds: float


class _Past(NamedTuple):
    """A job that has succeeded, and how large it was by what is known now."""

    done: _Done
    size: _Size | None


class _Remembered:
    """The latest jobs of each kind, read again once another one is the latest.

    Pages ask for an estimate whenever something has happened, and reading hundreds of jobs takes longer than
    everything else about it. One that is tried again is remembered until then: what it took is still true.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kinds: dict[str, tuple[_Latest, tuple[_Done, ...]]] = {}

    def of_kind(self, session: Session, kind: str) -> tuple[_Done, ...]:
        """Return the latest jobs of a kind that have succeeded."""
        latest = session.execute(
            select(JobRow.id, JobRow.finished_at).where(*_succeeded(kind)).order_by(_LATEST_FIRST).limit(1)
        ).one_or_none()
        if latest is None:
            return ()
        known_by: _Latest = (latest.id, latest.finished_at)
        with self._lock:
            known = self._kinds.get(kind)
        if known is not None and known[0] == known_by:
            return known[1]
        found = _done(session, kind)
        with self._lock:
            self._kinds[kind] = (known_by, found)
        return found


_REMEMBERED_JOBS = _Remembered()


class History:
    """What jobs of a kind have taken before.

    Parameters
    ----------
    hosts
        That work now.
    by_frames
        Kinds whose jobs take longer for more frames.
    jobs
        Those that will be asked about.
    """

    def __init__(
        self, session: Session, hosts: Collection[str], by_frames: Collection[str], jobs: Iterable[Coming]
    ) -> None:
        self._session = session
        self._hosts = hosts
        self._by_frames = by_frames
        self._past: dict[str, list[_Past]] = {}
        self._campaigns: dict[int, _Images] = {}
        self._medians: dict[tuple[Any, ...], float | None] = {}
        self._learn({job.campaign_id for job in jobs})

    def seconds(self, job: Coming) -> float | None:
        """Return the median of the jobs that are most like this one; None where its kind has never run."""
        size = self._size(job.kind, job.campaign_id, job.subject)
        key = (job.kind, job.kind_version, str(job.parameters), size)
        if key not in self._medians:
            self._medians[key] = self._median(job, size)
        return self._medians[key]

    def _median(self, job: Coming, size: _Size | None) -> float | None:
        by_likeness: dict[tuple[bool, ...], list[float]] = defaultdict(list)
        for past in self._of_kind(job.kind):
            alike = (
                past.done.parameters == job.parameters,
                past.size == size,
                past.done.host in self._hosts,
                past.done.version == job.kind_version,
            )
            by_likeness[alike].append(past.done.seconds * self._ratio(job.kind, size, past.size))
        return median(by_likeness[max(by_likeness)]) if by_likeness else None

    def _ratio(self, kind: str, size: _Size | None, past: _Size | None) -> float:
        if size is None or past is None:
            return 1.0
        frames = size.frames / past.frames if kind in self._by_frames else 1.0
        return size.pixels / past.pixels * frames

    def _of_kind(self, kind: str) -> list[_Past]:
        if kind not in self._past:
            found = _REMEMBERED_JOBS.of_kind(self._session, kind)
            self._learn({done.campaign_id for done in found})
            self._past[kind] = [
                _Past(done, self._size(kind, done.campaign_id, done.subject)) for done in found
            ]
        return self._past[kind]

    def _size(self, kind: str, campaign_id: int, subject: str) -> _Size | None:
        return self._campaigns[campaign_id].size(Subject.parse(subject))

    def _learn(self, campaigns: Collection[int]) -> None:
        # Of all at once: one by one they would take longer than everything else of an estimate.
        for some in parts(sorted(set(campaigns) - self._campaigns.keys())):
            self._campaigns |= _images(self._session, some)


@dataclass(frozen=True)
class _Images:
    """The images of a campaign: pixels of a view's camera, frames of a measurement, number of states."""

    pixels: Mapping[str, int]
    frames: int
    states: int

    def size(self, subject: Subject) -> _Size | None:
        if subject.view is not None:
            pixels = self.pixels.get(subject.view, 0)
        else:
            pixels = sum(self.pixels.values()) * (self.states if subject.state is None else 1)
        return _Size(pixels, self.frames) if pixels and self.frames else None


def _images(session: Session, numbers: Sequence[int]) -> dict[int, _Images]:
    """Return the images of campaigns that are few enough for one statement."""
    used = valid_calibrations.used_for_campaigns(session, numbers)
    states = number_of_states(session, numbers)
    rows = session.execute(
        select(CampaignRow.id, CampaignRow.views, CampaignRow.frames).where(CampaignRow.id.in_(numbers))
    )
    found = {}
    for number, views, frames in rows:
        pixels = {
            name: sensor["columns"] * sensor["rows"]
            for calibration in used[number]
            for name, sensor in calibration.sensors.items()
        }
        of_views = {view: pixels.get(view_of(view).camera, 0) for view in views}
        found[number] = _Images(of_views, frames, states.get(number, 0))
    return found


def _succeeded(kind: str) -> tuple[ColumnElement[bool], ...]:
    """Select the jobs of a kind that tell how long it takes."""
    return (
        JobRow.kind == kind,
        JobRow.state == JobState.SUCCEEDED,
        JobRow.reused_from.is_(None),
        JobRow.started_at.is_not(None),
    )


def _done(session: Session, kind: str) -> tuple[_Done, ...]:
    rows = session.execute(
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
        .where(*_succeeded(kind))
        .order_by(_LATEST_FIRST)
        .limit(_REMEMBERED)
    )
    return tuple(
        _Done(version, parameters, campaign, subject, host, _between(begun, ended))
        for version, parameters, campaign, subject, host, begun, ended in rows
    )


def _between(begun: datetime | None, ended: datetime | None) -> float:
    # A clock that was set back makes no job end before it began.
    return max((ended - begun).total_seconds(), 0.0) if begun and ended else 0.0
