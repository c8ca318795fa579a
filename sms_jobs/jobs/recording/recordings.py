"""What was recorded with instruments: verdicts on what is there, and what waits for an operator.

Instruments are loaded where the spool or a stage is asked: whoever lists states needs none of them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.asking.inquiry import find_job
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.planning.graph import PIPELINE, Request
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.recording.names import ACQUIRE, RECORDING
from sms_jobs.records.job import ACTIVE, SHORT_ID, JobState
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign, LoadState

_WAITING = frozenset({JobState.LOST, JobState.NEEDS_OPERATOR})
OPEN = (JobState.QUEUED, JobState.RUNNING, JobState.LOST, JobState.NEEDS_OPERATOR, JobState.FAILED)


@dataclass(frozen=True)
class PairVerdict:
    """What is known of one recorded view.

    Attributes
    ----------
    subject
        The tuple, `campaign/state/view`.
    statistics
        Those of its recording, by name.
    """

    subject: str
    statistics: dict[str, float]


def verdicts(session: Session, chosen: Chosen) -> list[PairVerdict]:
    """Return what is known of the views that some jobs have recorded, in order."""
    rows = session.execute(
        select(
            CampaignRow.name,
            LoadStateRow.label,
            FileRow.view,
            FileRow.id,
            StatisticRow.name,
            StatisticRow.value,
        )
        .join(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .join(StatisticRow, StatisticRow.file_id == FileRow.id)
        .join(JobRow, JobRow.id == FileRow.job_id)
        .where(*chosen.where, FileRow.source == MEASUREMENT)
        .order_by(FileRow.id)
    )
    found: dict[int, PairVerdict] = {}
    for campaign, label, view, file_id, name, value in rows:
        subject = str(Subject(campaign, label, view))
        found.setdefault(file_id, PairVerdict(subject, {})).statistics[name] = value
    return list(found.values())


@dataclass(frozen=True)
class OpenRecording:
    """A recording that has not ended well.

    Attributes
    ----------
    job_id, subject, state
        Of the job.
    reason
        Why it stands where it does.
    host
        Where it was begun last, and its frames are; empty before that.
    here
        Whether the spool of this host has frames of it; nothing is known of those of other hosts.
    finished
        Views that are in the spool as a whole.
    doubts
        What is doubted about them.
    """

    job_id: str
    subject: str
    state: JobState
    reason: str
    host: str
    here: bool
    finished: tuple[str, ...]
    doubts: tuple[str, ...]


def open_recordings(session: Session, spool: Path) -> list[OpenRecording]:
    """Return the recordings that run or wait for an operator, oldest first; `spool` is that of this host."""
    from sms_jobs.instruments.kept_sets import finished_sets

    rows = session.execute(
        select(JobRow, WorkerRow.host)
        .outerjoin(WorkerRow, WorkerRow.id == JobRow.worker_id)
        .where(
            JobRow.kind.in_(RECORDING),
            JobRow.state.in_(OPEN),
        )
        .order_by(JobRow.position)
    )
    found = []
    for row, host in rows:
        frames = spool / row.id
        finished = finished_sets(frames)
        doubts = tuple(words for one in finished.values() for words in one.verdict.doubts)
        found.append(
            OpenRecording(
                row.id,
                row.subject,
                row.state,
                row.error or row.message or "",
                host or "",
                frames.is_dir(),
                tuple(finished),
                doubts,
            )
        )
    return found


def recording_row(session: Session, prefix: str) -> JobRow:
    """Return the recording whose id begins so; raise as `find_job` does, `InvalidInput` for another job."""
    row = find_job(session, prefix)
    if row.kind not in RECORDING:
        short = row.id[:SHORT_ID]
        raise InvalidInput(f"job {short} is no recording but a {row.kind}; see 'sms job retry'")
    return row


def requests(
    states: tuple[str, ...], *, ask: bool, process: bool, look: Request | None = None
) -> list[Request]:
    """Return what records some states, asking about doubtful sets, and looking at and processing each."""
    found = [Request(ACQUIRE, {"doubtful": "ask" if ask else "keep"}, states)]
    found += [look] if look is not None else []
    return [*found, Request(PIPELINE, {}, states)] if process else found


@dataclass(frozen=True)
class Turn:
    """States that are recorded one after the other while nobody lays a hand on anything.

    Attributes
    ----------
    by_hand
        What somebody has to do before; empty where nothing is to be done.
    labels
        Of the states.
    """

    by_hand: str
    labels: tuple[str, ...]


def turns(states: Sequence[LoadState], *, at_key: bool = False) -> list[Turn]:
    """Return the order in which states are recorded, with what somebody has to do between them.

    A specimen is loaded by others; with `at_key` somebody says of each state that its load is there. An
    artefact without angles of a stage is placed by hand, pose by pose; one on a stage is mounted once.
    """
    from sms_jobs.kinds.recording.acquire import stage_angles

    found: list[Turn] = []
    mounted: str | None = None
    for state in states:
        on_stage = stage_angles(state) is not None
        by_hand = ""
        if state.artefact is not None and not on_stage:
            by_hand = f"{state.label}: place the {state.artefact}"
        elif state.artefact is not None and state.artefact != mounted:
            by_hand = f"{state.label}: mount the {state.artefact} on the stage"
        elif at_key:
            by_hand = f"{state.label} is next"
        mounted = state.artefact if on_stage else None
        if by_hand or not found:
            found.append(Turn(by_hand, (state.label,)))
        else:
            found[-1] = Turn(found[-1].by_hand, (*found[-1].labels, state.label))
    return found


def unrecorded(session: Session, name: str) -> tuple[LoadState, ...]:
    """Return the states of a campaign that are neither recorded nor about to be.

    Fringes are there when those of one view are; of cameras without a projector every image counts. Either
    may have been imported without the other.
    """
    campaign = definition(campaign_row(session, name))
    views = recorded_views(session, name)
    recorded = {label for label, found in views.items() if _is_recorded(campaign, label, found)}
    coming = {
        Subject.parse(subject).state
        for subject in session.scalars(
            select(JobRow.subject)
            .join(CampaignRow, CampaignRow.id == JobRow.campaign_id)
            .where(CampaignRow.name == name, JobRow.kind == ACQUIRE, JobRow.state.in_(OPEN))
        )
    }
    return tuple(s for s in campaign.states if s.label not in recorded | coming)


def recorded_views(session: Session, name: str) -> dict[str, set[str]]:
    """Return what there are frames of, by label of the states of a campaign that have any."""
    there = session.execute(
        select(LoadStateRow.label, FileRow.view)
        .join(CampaignRow, CampaignRow.id == LoadStateRow.campaign_id)
        .join(FileRow, FileRow.state_id == LoadStateRow.id)
        .where(CampaignRow.name == name, FileRow.source == MEASUREMENT)
    )
    views: defaultdict[str, set[str]] = defaultdict(set)
    for label, view in there:
        views[label].add(view or "")
    return views


def refuse_while_recording(session: Session, name: str) -> None:
    """Raise `Conflict` where a recording of a campaign is about to begin, runs, or waits for an operator."""
    found = session.scalar(
        select(JobRow.id)
        .join(CampaignRow, CampaignRow.id == JobRow.campaign_id)
        .where(CampaignRow.name == name, JobRow.kind.in_(RECORDING), JobRow.state.in_(ACTIVE | _WAITING))
        .limit(1)
    )
    if found is not None:
        raise Conflict(
            f"job {found[:SHORT_ID]} records {name}, or waits for an operator: let it end or stop it first; "
            "'sms acquire list' shows it"
        )


def _is_recorded(campaign: Campaign, label: str, views: Set[str]) -> bool:
    """Say whether measurements of some views are what a state has to have."""
    fringes = set(campaign.fringe_views)
    wanted = set(campaign.recordings_at(label))
    return (not fringes & wanted or bool(fringes & views)) and wanted - fringes <= views


def state_value(state: LoadState, channel: str) -> float:
    """Return what a channel is to read at a state.

    Raises `InvalidInput` when the plan does not say it.
    """
    planned = state.planned()
    if channel not in planned:
        names = ", ".join(planned) or "none"
        raise InvalidInput(
            f"the plan does not say what {channel} is at state {state.label}; it says {names}: give its "
            "load_n or channels"
        )
    return planned[channel]


def forget_doubtful(spool: Path) -> list[str]:
    """Have the doubtful sets of a job recorded again; their frames stay. Return their views."""
    from sms_jobs.instruments.kept_sets import finished_sets, forget

    doubtful = [view for view, one in finished_sets(spool).items() if one.verdict.doubts]
    for view in doubtful:
        forget(spool, view)
    return doubtful
