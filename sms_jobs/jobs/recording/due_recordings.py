"""Planned recordings begin: each once, whoever looks and whenever a supervisor ends.

Whether one has started is one column, which one statement changes in the transaction that enters its jobs: a
start that breaks off before that has done nothing, and a later one finds it started. The ids of the jobs
follow from the row, so that they could not be entered twice either.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session, aliased

from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue import changes
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.subject_files import newest_file
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.planned import PlannedRecordingRow
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Draft, Terms, draft, enter, while_outdated
from sms_jobs.jobs.recording import planned_recordings, recordings
from sms_jobs.jobs.recording.planned_recordings import Planned
from sms_jobs.kinds.deformation.quick_look import KIND as LOOK
from sms_jobs.kinds.deformation.quick_look import subjects_looked_at
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.recording.acquire import KIND
from sms_jobs.records import triggers
from sms_jobs.records.job import SHORT_ID, JobState
from sms_jobs.records.shown.planned_recordings import Status
from sms_jobs.records.statistic_names import after, before
from sms_jobs.records.subject import Subject
from sms_jobs.records.triggers import Counted, Holding, Trigger
from sms_jobs.records.units import in_unit_of_name

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign, LoadState


_FIRST = 100
"""Priority of quick looks: the highest that there is, so that they come before results of other states."""


@dataclass(frozen=True)
class Asked:
    """What a plan asks for when a recording begins.

    Attributes
    ----------
    campaign, label
        What is recorded.
    by
        Who has planned it.
    ask, process, look
        See `recordings.requests`.
    key
        What the ids of its jobs follow from.
    """

    campaign: str
    label: str
    by: str
    ask: bool
    process: bool
    look: bool
    key: str


@dataclass(frozen=True)
class Due:
    """A recording that comes next and has not started.

    Attributes
    ----------
    row_id, revision
        By which it is known; another trigger, or another place in the order, gives another revision.
    campaign, rig, label
        What is recorded, and by what.
    trigger
        What it waits for.
    before
        When the recording before it was due; None where there was none.
    planned_at, planned_by
        When, and by whom.
    ask, process, look
        See `recordings.requests`.
    note
        What is known to keep it from being watched.
    """

    row_id: int
    revision: int
    campaign: str
    rig: str
    label: str
    trigger: Trigger
    before: datetime | None
    planned_at: datetime
    planned_by: str
    ask: bool
    process: bool
    look: bool
    note: str | None

    @property
    def asked(self) -> Asked:
        """What is asked for when it begins."""
        at = self.planned_at.isoformat()
        key = f"planned/{self.campaign}/{self.label}/{self.row_id}/{self.revision}/{at}"
        return Asked(self.campaign, self.label, self.planned_by, self.ask, self.process, self.look, key)


def plannable(session: Session, campaign: str, labels: Collection[str] = ()) -> tuple[LoadState, ...]:
    """Return the states of a campaign that a plan can record: those that are asked for, or all that are left.

    Raises
    ------
    Conflict
        One that is asked for is recorded or being recorded; or nothing is left.
    InvalidInput
        There is no such state, or it is a pose of a session, before which somebody has to be there.
    NotFound
        There is no such campaign.
    """
    row = campaign_row(session, campaign)
    defined = definition(row)
    refuse_session(defined)
    left = recordings.unrecorded(session, campaign)
    for label in labels:
        if defined.state(label) not in left:
            raise Conflict(
                f"{label} of {campaign} is recorded, or about to be; see 'sms acquire show {campaign}'"
            )
    if labels:
        return tuple(state for state in left if state.label in labels)
    there = {one.label for one in planned_recordings.planned(session, [row.id])}
    found = tuple(state for state in left if state.label not in there)
    if not found:
        raise Conflict(
            f"every state of {campaign} is recorded, planned or skipped: name a `state` to plan it "
            "again, or see 'sms acquire plan show'"
        )
    return found


def refuse_session(campaign: Campaign) -> None:
    """Raise `InvalidInput` for a calibration session: no plan carries its artefacts."""
    if campaign.session is not None:
        raise InvalidInput(
            f"{campaign.name} is a calibration session, whose artefacts a person places: use "
            "'sms acquire run'"
        )


def due(session: Session) -> list[Due]:
    """Return of each campaign the recording that comes next, where it has not started and may begin.

    What keeps it is somebody, or a quick look that was not checked against its limits yet.
    """
    awaited = select(PlannedRecordingRow.campaign_id).where(planned_recordings.AWAITED)
    looked_at = set(session.scalars(awaited))
    following = [
        one
        for one in planned_recordings.next_ones(session)
        if one.job is None and not one.row.held and one.row.campaign_id not in looked_at
    ]
    if not following:
        return []
    last = dict(
        session.execute(
            select(PlannedRecordingRow.campaign_id, func.max(PlannedRecordingRow.due_at))
            .where(PlannedRecordingRow.campaign_id.in_([one.row.campaign_id for one in following]))
            .group_by(PlannedRecordingRow.campaign_id)
        ).all()
    )
    return [
        Due(
            one.row.id,
            one.row.revision,
            one.campaign,
            one.rig,
            one.label,
            triggers.from_json(one.row.trigger),
            last[one.row.campaign_id],
            one.row.planned_at,
            one.row.planned_by,
            one.row.ask,
            one.row.process,
            one.row.look,
            one.row.note,
        )
        for one in following
    ]


def settle(catalogue: Catalogue) -> None:
    """Note of planned recordings that they are recorded, by the plan or beside it, and what is doubted."""
    with catalogue.reading() as session:
        found = {
            one.row.id: (
                one,
                _found_at(session, one) if one.job is not None else "recorded outside the plan",
            )
            for one in planned_recordings.next_ones(session)
            if _is_recorded(session, one)
        }
    if not found:
        return
    with catalogue.writing() as session:
        for row_id, (one, note) in found.items():
            noted = session.scalar(
                update(PlannedRecordingRow)
                .where(PlannedRecordingRow.id == row_id, planned_recordings.OPEN)
                .values(status=Status.RECORDED.value, note=note)
                .returning(PlannedRecordingRow.id)
                .execution_options(synchronize_session=False)
            )
            if noted is not None:
                changes.of_recordings(session, one.campaign, [one.label], "recorded", note or "")


def _is_recorded(session: Session, one: Planned) -> bool:
    if one.job is not None:
        return one.job.state is JobState.SUCCEEDED
    there = select(FileRow.id).where(FileRow.state_id == one.row.state_id, FileRow.source == MEASUREMENT)
    if session.scalar(there.limit(1)) is None:
        return False
    left = recordings.unrecorded(session, one.campaign)
    return not _others(session, one.campaign, one.label) and one.label not in {state.label for state in left}


def _others(session: Session, campaign: str, label: str) -> str | None:
    """Return the job that records a state and that no plan has started; None where there is none."""
    return session.scalar(
        select(JobRow.id).where(
            JobRow.kind == KIND.name,
            JobRow.subject == str(Subject(campaign, label)),
            JobRow.state.in_(recordings.OPEN),
        )
    )


def _found_at(session: Session, one: Planned) -> str | None:
    """Say what a channel read when it was not what was waited for; None where it was."""
    trigger = triggers.from_json(one.row.trigger)
    if not isinstance(trigger, Holding | Counted):
        return None
    names = (before(trigger.channel), after(trigger.channel))
    rows = session.execute(
        select(StatisticRow.name, func.min(StatisticRow.value), func.max(StatisticRow.value))
        .join(FileRow, FileRow.id == StatisticRow.file_id)
        .where(FileRow.job_id == one.row.job_id, StatisticRow.name.in_(names))
        .group_by(StatisticRow.name)
    )
    size = in_unit_of_name(trigger.channel, 1.0, trigger.unit) if isinstance(trigger, Holding) else 1.0
    return doubt(trigger, {name: (low / size, high / size) for name, low, high in rows})


def doubt(trigger: Holding | Counted, read: Mapping[str, tuple[float, float]]) -> str | None:
    """Say where a recording was not made in what was waited for.

    Parameters
    ----------
    read
        Least and greatest readings of all its sets, by `channel_before` and `channel_after`, in the unit of
        the trigger.
    """
    if not read:
        return f"{trigger.channel} was not read while it was recorded"
    low, high = min(low for low, _ in read.values()), max(high for _, high in read.values())
    between = f"while it was recorded {trigger.channel} read {low:g} to {high:g}"
    if isinstance(trigger, Holding):
        inside = max(high - trigger.target, trigger.target - low) <= trigger.tolerance
        return None if inside else f"{between} {trigger.unit}, not {trigger}"
    return f"{between}: it did not stand still" if trigger.for_s and low != high else None


def begin(
    catalogue: Catalogue, one: Due, due_at: datetime, now: datetime, holder: str | None = None
) -> str | None:
    """Enter the recording of a state, and return the id of its job; None where that is not to be any more.

    It is not where somebody else has started it, held it back or changed it since `due`.

    Parameters
    ----------
    due_at
        By which time it begins.
    holder
        That holds the rig meanwhile and gives it back in the same transaction.

    Raises
    ------
    Conflict
        Another job records the state.
    InvalidInput, NotFound, PlanOutdated
        See `submission.submit_to`.
    """
    return while_outdated(partial(_begin, catalogue, one, due_at, now, holder))


def rehearse(catalogue: Catalogue, one: Due, now: datetime) -> None:
    """Raise what `begin` would, and enter nothing; the kinds are loaded then, so that it takes no time."""
    with catalogue.reading() as session:
        _drafted(session, one, now)


def _drafted(session: Session, one: Due, now: datetime) -> Draft:
    planned = drafted(session, one.asked, now)
    other = _others(session, one.campaign, one.label)
    if other is not None and other != recording_of(planned):  # its own: somebody was faster
        raise Conflict(
            f"job {other[:SHORT_ID]} records {one.campaign}/{one.label} already; 'sms acquire list' shows it"
        )
    return planned


def drafted(session: Session, one: Asked, now: datetime, amended: Campaign | None = None) -> Draft:
    """Plan the jobs of a recording, and enter nothing; see `submission.draft` for `amended`."""
    look = _look(session, one) if one.look else None
    wanted = recordings.requests((one.label,), ask=one.ask, process=one.process, look=look)
    terms = Terms(by=f"plan of {one.by}"[:80])
    return draft(session, one.campaign, wanted, now, terms, key=one.key, amended=amended).whole()


def recording_of(planned: Draft) -> str:
    """Return the id of the job that records."""
    submitted = planned.submission
    return submitted.job_ids[submitted.kinds.index(KIND.name)]


def _look(session: Session, one: Asked) -> Request:
    """Return the quick look at a state: at its shape alone where views have no reference."""
    campaign = definition(campaign_row(session, one.campaign))
    rest = campaign.reference.label
    there = (
        newest_file(session, MEASUREMENT, recorded, DATASET_MEDIA_TYPE)
        for looked_at in subjects_looked_at(campaign)
        if looked_at.state == rest and looked_at.view not in campaign.late_views
        for recorded in looked_at.recordings
    )
    alone = one.label != rest and None in there
    return Request(LOOK.name, {"alone": alone}, (one.label,), priority=_FIRST)


def _begin(catalogue: Catalogue, one: Due, due_at: datetime, now: datetime, holder: str | None) -> str | None:
    with catalogue.reading() as session:
        planned = _drafted(session, one, now)
    job_id = recording_of(planned)
    with catalogue.writing() as session:
        if not _claimed(session, one, due_at):
            return None
        enter(session, planned)
        changes.of_recordings(session, one.campaign, [one.label], "begun")
        session.execute(
            update(PlannedRecordingRow).where(PlannedRecordingRow.id == one.row_id).values(job_id=job_id)
        )
        if holder is not None:
            locks.release(session, holder=holder)
    return job_id


def _claimed(session: Session, one: Due, due_at: datetime) -> bool:
    """Take a planned recording by one statement; False where somebody was faster, or it was changed."""
    other = aliased(JobRow)
    taken = session.scalar(
        update(PlannedRecordingRow)
        .where(
            PlannedRecordingRow.id == one.row_id,
            PlannedRecordingRow.revision == one.revision,
            PlannedRecordingRow.status == Status.PLANNED.value,
            PlannedRecordingRow.held.is_(False),
            ~select(other.id)
            .where(
                other.kind == KIND.name,
                other.subject == str(Subject(one.campaign, one.label)),
                other.state.in_(recordings.OPEN),
            )
            .exists(),
        )
        .values(status=Status.BEGUN.value, due_at=due_at, note=None)
        .returning(PlannedRecordingRow.id)
        .execution_options(synchronize_session=False)
    )
    return taken is not None
