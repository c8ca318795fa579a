"""A level of a stepped test is held: the campaign is given one more state, and its recording begins.

All of that is one transaction: the state, its planned recording, the jobs and the rig that they need. Where
it breaks off there is nothing of it, and otherwise an ordinary planned recording that has started. Nothing
waits for a load that was held before and is gone by now.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue import changes
from sms_jobs.catalogue.campaigns import campaign_row, definition, state_ids
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.planned import PlannedLevelsRow, PlannedRecordingRow
from sms_jobs.errors import Conflict
from sms_jobs.jobs.archiving.importing import amend_campaign, with_state
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.planning.submission import Draft, enter
from sms_jobs.jobs.recording import planned_levels
from sms_jobs.jobs.recording.due_recordings import Asked, drafted, recording_of
from sms_jobs.jobs.recording.planned_levels import PlannedLevels
from sms_jobs.jobs.recording.planned_recordings import AWAITED, OPEN
from sms_jobs.records import triggers
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.levels import Levels, next_label
from sms_jobs.records.shown.planned_recordings import Status
from sms_jobs.records.units import in_unit_of_name

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

_TRIES = 20
"""So often a state is added anew because the campaign was changed meanwhile, or what its jobs build on."""


@dataclass(frozen=True)
class DueLevels:
    """Levels of a campaign whose turn it is: nothing else of its plan is open.

    Attributes
    ----------
    campaign_id, revision
        By which they are known; once a state is added, or other levels are planned, the revision is another.
    campaign, rig
        Whose, and what measures it.
    levels
        At which loads a state is added.
    last
        The level that was recorded last; None where there is none.
    planned_at, planned_by
        When, and by whom.
    ask, process, look
        See `recordings.requests`.
    note
        What is known to keep the channel from being watched.
    """

    campaign_id: int
    revision: int
    campaign: str
    rig: str
    levels: Levels
    last: float | None
    planned_at: datetime
    planned_by: str
    ask: bool
    process: bool
    look: bool
    note: str | None

    def asked(self, label: str) -> Asked:
        """Return what is asked for when the recording of a new state begins."""
        key = f"levels/{self.campaign}/{label}/{self.revision}/{self.planned_at.isoformat()}"
        return Asked(self.campaign, label, self.planned_by, self.ask, self.process, self.look, key)


@dataclass(frozen=True)
class Added:
    """A state that was added, and the job that records it."""

    label: str
    job_id: str


class _TooLate(Exception):
    """Somebody has added a state, held the plan back or changed it."""


def due(session: Session) -> list[DueLevels]:
    """Return the levels of each campaign of which nothing else is planned, where they are not held back."""
    busy = set(session.scalars(select(PlannedRecordingRow.campaign_id).where(OPEN | AWAITED)))
    following = planned_levels.planned_levels(session)
    free = [one for one in following if not one.row.held and one.row.campaign_id not in busy]
    return [_due(session, one) for one in free]


def _due(session: Session, one: PlannedLevels) -> DueLevels:
    row = one.row
    return DueLevels(
        row.campaign_id,
        row.revision,
        one.campaign,
        one.rig,
        one.levels,
        planned_levels.last_level(session, one),
        row.planned_at,
        row.planned_by,
        row.ask,
        row.process,
        row.look,
        row.note,
    )


def rehearse(catalogue: Catalogue, one: DueLevels, now: datetime) -> None:
    """Raise what `add` would of the jobs, and enter nothing: they are planned for the state at level 0."""
    with catalogue.reading() as session:
        before = definition(campaign_row(session, one.campaign))
        state = _state(before, one.levels, 0.0)
        drafted(session, one.asked(state.label), now, with_state(before, state))


def add(
    catalogue: Catalogue,
    archive: Archive,
    one: DueLevels,
    level: float,
    now: datetime,
    holder: str | None = None,
) -> Added | None:
    """Add a state at a level and begin its recording; None where that is not to be any more.

    It is not where somebody else has added one, held the plan back or changed it since `due`.

    Parameters
    ----------
    level
        In the unit of the channel.
    holder
        That holds the rig meanwhile and gives it back in the same transaction.

    Raises
    ------
    Conflict, PlanOutdated
        The campaign, or what the jobs build on, changes faster than that.
    InvalidInput, NotFound
        See `submission.submit_to`.
    """
    tries = 0
    while True:
        with catalogue.reading() as session:
            if _is_late(session, one, level):
                return None
            before = definition(campaign_row(session, one.campaign))
            state = _state(before, one.levels, level)
            after = with_state(before, state)
            planned = drafted(session, one.asked(state.label), now, after)
        effects = _Changes(one, state.label, level, planned, now, holder)
        try:
            amend_campaign(catalogue, archive, before, after, now, effects.claim, effects.enter)
        except _TooLate:
            return None
        except Conflict:
            # Another state was added meanwhile, or a job has ended that these would wait for.
            tries += 1
            if tries == _TRIES:
                raise
        else:
            return Added(state.label, recording_of(planned))


def _is_late(session: Session, one: DueLevels, level: float) -> bool:
    """Say whether levels are not those any more that were due, or the level was recorded meanwhile."""
    now = next((each for each in due(session) if each.campaign_id == one.campaign_id), None)
    return now is None or now.revision != one.revision or now.last == level


def _state(campaign: Campaign, levels: Levels, level: float) -> LoadState:
    """Return the next state of a campaign, as it is planned in the unit of the channel's name."""
    label = next_label([state.label for state in campaign.states])
    value = in_unit_of_name(levels.channel, level, levels.unit)
    if levels.channel == "load_n":
        return LoadState(label, load_n=value)
    if levels.channel == "displacement_mm":
        return LoadState(label, displacement_mm=value)
    return LoadState(label, channels={levels.channel: value})


@dataclass(frozen=True)
class _Changes:
    """What the transaction changes that adds a state, beside the campaign."""

    one: DueLevels
    label: str
    level: float
    planned: Draft
    now: datetime
    holder: str | None

    def claim(self, session: Session) -> None:
        """Take the level by one statement; raise `_TooLate` where somebody was faster, or it was changed."""
        number = self.one.campaign_id
        if _is_late(session, self.one, self.level):
            raise _TooLate
        taken = session.scalar(
            update(PlannedLevelsRow)
            .where(
                PlannedLevelsRow.campaign_id == number,
                PlannedLevelsRow.revision == self.one.revision,
                PlannedLevelsRow.held.is_(False),
            )
            .values(revision=self.one.revision + 1, note=None)
            .returning(PlannedLevelsRow.campaign_id)
            .execution_options(synchronize_session=False)
        )
        if taken is None:
            raise _TooLate

    def enter(self, session: Session) -> None:
        """Enter the planned recording of the state, which has started, and its jobs; let the rig go."""
        number = self.one.campaign_id
        state_id = state_ids(session, number, [self.label])[self.label]
        job_id = recording_of(self.planned)
        enter(session, self.planned)
        for became in ("planned", "begun"):
            changes.of_recordings(session, self.one.campaign, [self.label], became)
        row = session.get_one(PlannedLevelsRow, number, populate_existing=True)
        last = select(func.max(PlannedRecordingRow.position)).where(PlannedRecordingRow.campaign_id == number)
        session.add(
            PlannedRecordingRow(
                campaign_id=number,
                state_id=state_id,
                position=(session.scalar(last) or 0) + 1,
                trigger=triggers.as_json(self.one.levels.at(self.level)),
                ask=row.ask,
                process=row.process,
                status=Status.BEGUN.value,
                held=False,
                revision=0,
                planned_at=self.now,
                planned_by=row.planned_by,
                due_at=self.now,
                job_id=job_id,
                seen=row.seen,
                seen_at=row.seen_at,
                look=row.look,
                stop_if=row.stop_if,
                awaited=bool(row.stop_if),
            )
        )
        row.last, row.last_state_id = self.level, state_id
        row.last_file_id = planned_levels.newest_measurement(session, number)
        session.flush()
        if self.holder is not None:
            locks.release(session, holder=self.holder)
