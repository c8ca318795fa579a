"""How far a campaign is: of each state, view and kind, what there is and whether it still holds."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import TypeAlias

from sqlalchemy import String, or_, select, true, type_coerce
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue.subjects import at_states
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.jobs.results.stale import stale_files
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.job import ACTIVE, JobState
from sms_jobs.records.record_names import PICTURED
from sms_jobs.records.shown.cells import Cell
from sms_jobs.records.subject import Subject

_Place: TypeAlias = tuple[str | None, str | None, str]
"""State, view and kind."""
_SUCCEEDED = JobState.SUCCEEDED.value
_ACTIVE = frozenset(state.value for state in ACTIVE)
_TELLING = _ACTIVE | {s.value for s in (JobState.FAILED, JobState.QUARANTINED, JobState.NEEDS_OPERATOR)}
"""States of the newest job that matter where an older one has given a result."""


@dataclass(frozen=True)
class _File:
    number: int
    media_type: str


def matrix(
    session: Session, campaign: CampaignRow, now: datetime, states: Collection[str] = ()
) -> list[Cell]:
    """Return what there is of a campaign, the oldest first, in a few queries however large it is.

    What is stale, and why, `stale_files` says. Where the newest job has reused a result, that is what there
    is.

    Parameters
    ----------
    states
        Labels of those of which it is returned, beside what is about the whole campaign; empty for all.
    """
    files, by_job = _files(session, campaign.id, states)
    jobs = _jobs(session, campaign, states)
    stale, pictured = stale_files(session, campaign, now), _pictured_kinds()
    cells = []
    for state, view, kind in dict.fromkeys([*files, *jobs]):
        place = (state, view, kind)
        job = jobs.get(place)
        file = by_job.get((place, "" if job is None else job.reused_from or ""), files.get(place))
        why = ""
        if job is not None and job.state != _SUCCEEDED and (file is None or job.state in _TELLING):
            condition, why = job.state, job.why
        elif file is None or (kind != MEASUREMENT and kind not in all_kinds()):
            continue  # not made yet, or no result: the definition of the campaign
        elif kind == MEASUREMENT:
            condition = "measured"
        else:
            why = stale.get(file.number, "")
            condition = "stale" if why else "computed"
        cells.append(
            Cell(
                *place,
                condition,
                None if file is None else file.number,
                "" if file is None else file.media_type,
                None if job is None else job.id,
                why,
                file is not None and file.media_type == DATASET_MEDIA_TYPE and kind in pictured,
            )
        )
    return cells


def _pictured_kinds() -> set[str]:
    """Return the kinds whose results have fields over an image, with the word for measurements."""
    of_kinds = {
        name for name, kind in all_kinds().items() if any(one.name in PICTURED for one in kind.records)
    }
    return of_kinds | {MEASUREMENT}


@dataclass(frozen=True)
class _Job:
    id: str
    state: str
    reused_from: str | None
    why: str


def _files(
    session: Session, campaign_id: int, states: Collection[str]
) -> tuple[dict[_Place, _File], dict[tuple[_Place, str], _File]]:
    """Return the newest file of each place, and that of each place and job."""
    wanted = or_(LoadStateRow.label.in_(list(states)), FileRow.state_id.is_(None)) if states else true()
    rows = session.execute(
        select(
            LoadStateRow.label,
            FileRow.view,
            FileRow.source,
            FileRow.id,
            FileRow.media_type,
            FileRow.job_id,
        )
        .outerjoin(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .where(FileRow.campaign_id == campaign_id, wanted)
        .order_by(FileRow.id)
    )
    newest: dict[_Place, _File] = {}
    by_job: dict[tuple[_Place, str], _File] = {}
    for label, view, source, number, media_type, job in rows:
        place = (label, view, source)
        newest[place] = by_job[place, job or ""] = _File(number, media_type)
    return newest, by_job


def _jobs(session: Session, campaign: CampaignRow, states: Collection[str]) -> dict[_Place, _Job]:
    """Return the newest job of each place."""
    # States as they are stored: of thousands, making each a `JobState` takes as long as reading them.
    rows = session.execute(
        select(
            JobRow.subject,
            JobRow.kind,
            JobRow.id,
            type_coerce(JobRow.state, String),
            JobRow.reused_from,
            JobRow.error,
            JobRow.message,
        )
        .where(
            JobRow.campaign_id == campaign.id,
            at_states(JobRow.subject, campaign.name, states) if states else true(),
        )
        .order_by(JobRow.position)
    )
    newest = {
        (subject, kind): (job, state, reused_from, error or message)
        for subject, kind, job, state, reused_from, error, message in rows
    }
    about = {text: Subject.parse(text) for text in dict.fromkeys(subject for subject, _ in newest)}
    found: dict[_Place, _Job] = {}
    for (text, kind), (job, state, reused_from, said) in newest.items():
        subject = about[text]
        why = "" if state in _ACTIVE else said
        found[subject.state, subject.view, kind] = _Job(job, state, reused_from, why)
    return found
