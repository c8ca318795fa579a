"""How a test comes along: which states are recorded, how good they are, and what is known of them already."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import datetime

from sqlalchemy import ColumnElement, String, select, true, type_coerce
from sqlalchemy.orm import Session

from sms_jobs.catalogue.campaigns import campaign_id
from sms_jobs.catalogue.subjects import at_states
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.recording.names import ACQUIRE
from sms_jobs.records.job import ACTIVE, UNSUCCESSFUL, JobState
from sms_jobs.records.shown.state_progress import StateProgress
from sms_jobs.records.statistic_names import (
    DOUBTS,
    MAXIMUM_PRINCIPAL_STRAIN,
    channels_before,
    maximum_displacement,
)
from sms_jobs.records.subject import Subject

_ACTIVE = frozenset(state.value for state in ACTIVE)
_SKIPPED, _CANCELLED = JobState.SKIPPED.value, JobState.CANCELLED.value
_FAILED = frozenset(state.value for state in UNSUCCESSFUL) - {_SKIPPED, _CANCELLED}
_LARGEST = {"correlate": maximum_displacement("mm"), "strain": MAXIMUM_PRINCIPAL_STRAIN}
"""By kind, the statistic that says at a glance what a state did."""


def progress_of(session: Session, name: str, states: Collection[str] = ()) -> list[StateProgress]:
    """Return how each state of a campaign comes along, in order; of some of them alone if they are given."""
    number = campaign_id(session, name)
    wanted = LoadStateRow.label.in_(list(states)) if states else true()
    files = _newest_files(session, number, wanted)
    jobs = _jobs(session, number, at_states(JobRow.subject, name, states) if states else true())
    # Not of the definition, which takes as long to read as everything else.
    rows = session.execute(
        select(LoadStateRow.label, LoadStateRow.planned_load_n)
        .where(LoadStateRow.campaign_id == number, wanted)
        .order_by(LoadStateRow.position)
    )
    return [_progress(label, load_n, files[label], jobs[label]) for label, load_n in rows]


@dataclass
class _Found:
    """The newest file of a source and view."""

    created_at: datetime
    statistics: dict[str, float] = field(default_factory=dict)


@dataclass
class _Jobs:
    """The jobs of a state."""

    recording: str = ""
    active: int = 0
    failed: int = 0
    skipped: int = 0
    cancelled: int = 0

    def count(self, state: str) -> None:
        """Count a job that processes it by the state of the job."""
        self.active += state in _ACTIVE
        self.failed += state in _FAILED
        self.skipped += state == _SKIPPED
        self.cancelled += state == _CANCELLED


def _newest_files(
    session: Session, campaign_id: int, wanted: ColumnElement[bool]
) -> defaultdict[str, dict[tuple[str, str], _Found]]:
    """Return by state, source and view what the newest file says, of the wanted states."""
    rows = session.execute(
        select(
            LoadStateRow.label,
            FileRow.source,
            FileRow.view,
            FileRow.id,
            FileRow.created_at,
            StatisticRow.name,
            StatisticRow.value,
        )
        .join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        # What was imported has no statistics.
        .outerjoin(StatisticRow, StatisticRow.file_id == FileRow.id)
        .where(
            FileRow.campaign_id == campaign_id,
            wanted,
            FileRow.source.in_((MEASUREMENT, *_LARGEST)),
            FileRow.view.is_not(None),
        )
        .order_by(FileRow.id)
    )
    found: defaultdict[str, dict[tuple[str, str], _Found]] = defaultdict(dict)
    newest: dict[tuple[str, str, str], int] = {}
    for label, source, of, file_id, created_at, name, value in rows:
        view = of or ""
        if newest.get((label, source, view)) != file_id:
            newest[label, source, view] = file_id
            found[label][source, view] = _Found(created_at)
        if name is not None:
            found[label][source, view].statistics[name] = value
    return found


def _jobs(session: Session, campaign_id: int, wanted: ColumnElement[bool]) -> defaultdict[str, _Jobs]:
    """Return by state what records and processes it; of jobs of one kind and subject the last counts.

    One that was skipped or cancelled did nothing, so that what one before it did still holds.
    """
    # States of jobs as they are stored: of thousands, making each a `JobState` takes as long as reading them.
    rows = session.execute(
        select(JobRow.kind, JobRow.subject, type_coerce(JobRow.state, String))
        .where(JobRow.campaign_id == campaign_id, wanted)
        .order_by(JobRow.position)
    )
    last: dict[tuple[str, str], str] = {}
    for kind, subject, state in rows:
        if (kind, subject) not in last or state not in (_SKIPPED, _CANCELLED):
            last[kind, subject] = state
    found: defaultdict[str, _Jobs] = defaultdict(_Jobs)
    labels = {subject: Subject.parse(subject).state for subject in {subject for _, subject in last}}
    for (kind, subject), state in last.items():
        label = labels[subject]
        if label is None:
            continue
        if kind == ACQUIRE:
            found[label].recording = state
        else:
            found[label].count(state)
    return found


def _progress(
    label: str, load_n: float | None, files: Mapping[tuple[str, str], _Found], jobs: _Jobs
) -> StateProgress:
    recorded = [f for (source, _), f in files.items() if source == MEASUREMENT]
    channels = {name: value for f in recorded for name, value in channels_before(f.statistics).items()}
    recording = jobs.recording
    if recorded and recording in ("", JobState.SUCCEEDED.value):
        recording = "recorded"
    return StateProgress(
        label,
        load_n,
        recording,
        max((f.created_at for f in recorded), default=None),
        len(recorded),
        sum(DOUBTS in f.statistics for f in recorded),
        sum(f.statistics.get(DOUBTS, 0.0) > 0.0 for f in recorded),
        channels,
        jobs.active,
        jobs.failed,
        jobs.skipped,
        jobs.cancelled,
        *(_largest(files, kind) for kind in _LARGEST),
    )


def _largest(files: Mapping[tuple[str, str], _Found], kind: str) -> float | None:
    name = _LARGEST[kind]
    values = [
        f.statistics[name] for (source, _), f in files.items() if source == kind and name in f.statistics
    ]
    return max(values, default=None)
