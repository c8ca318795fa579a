"""Plans of recordings: rows of the catalogue that say which state is recorded next, and when.

The recordings of a campaign come in one order. The first that is neither recorded nor skipped is next: it
begins when its trigger says so, and none begins before the one before it is recorded or skipped. Behind them
come the levels of `planned_levels`, which add further ones.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from datetime import datetime
from typing import NamedTuple

from sqlalchemy import ColumnElement, and_, func, or_, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue import changes
from sms_jobs.catalogue.campaigns import campaign_id, state_ids
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.planned import PlannedLevelsRow, PlannedRecordingRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound, did_you_mean
from sms_jobs.jobs.recording import planned_levels
from sms_jobs.records import triggers
from sms_jobs.records.gauge_limits import NO_LOOK, Look
from sms_jobs.records.job import SHORT_ID, JobState
from sms_jobs.records.shown.planned_recordings import Dropped, Status
from sms_jobs.records.triggers import Trigger

_OPEN = (Status.PLANNED.value, Status.BEGUN.value)
OPEN = PlannedRecordingRow.status.in_(_OPEN)
"""Of a row that was neither skipped nor noted as recorded."""
AWAITED = and_(PlannedRecordingRow.status == Status.RECORDED.value, PlannedRecordingRow.awaited.is_(True))
"""Of a row whose quick look was not checked against its limits yet."""
_RUNS = (JobState.QUEUED, JobState.WAITING, JobState.RUNNING, JobState.LOST)


class Planned(NamedTuple):
    """A row, and what it is about."""

    row: PlannedRecordingRow
    campaign: str
    rig: str
    label: str
    job: JobRow | None

    @property
    def is_recorded(self) -> bool:
        """Whether it is recorded, noted in its row or not yet."""
        done = self.job is not None and self.job.state is JobState.SUCCEEDED
        return self.row.status == Status.RECORDED.value or done

    @property
    def is_open(self) -> bool:
        """Whether it is neither recorded nor skipped."""
        return self.row.status in _OPEN and not self.is_recorded


def planned(session: Session, campaigns: Collection[int]) -> list[Planned]:
    """Return the rows of some campaigns, in their order."""
    return _rows(session, PlannedRecordingRow.campaign_id.in_(campaigns))


def anything_open(session: Session) -> bool:
    """Say whether anything is planned: levels, or what was neither skipped nor recorded and looked at."""
    rows = select(PlannedRecordingRow.id).where(or_(OPEN, AWAITED)).exists()
    levels = select(PlannedLevelsRow.campaign_id).exists()
    return bool(session.scalar(select(or_(rows, levels))))


def next_ones(session: Session) -> list[Planned]:
    """Return of each campaign the first recording that was neither skipped nor noted as recorded."""
    first = (
        select(PlannedRecordingRow.campaign_id, func.min(PlannedRecordingRow.position))
        .where(OPEN)
        .group_by(PlannedRecordingRow.campaign_id)
        .order_by(PlannedRecordingRow.campaign_id)
    )
    places = session.execute(first).all()
    return [
        one
        for number, position in places
        for one in _rows(
            session,
            and_(PlannedRecordingRow.campaign_id == number, PlannedRecordingRow.position == position, OPEN),
        )
    ]


def _rows(session: Session, which: ColumnElement[bool]) -> list[Planned]:
    rows = session.execute(
        select(PlannedRecordingRow, CampaignRow.name, RigRow.name, LoadStateRow.label, JobRow)
        .join(CampaignRow, CampaignRow.id == PlannedRecordingRow.campaign_id)
        .join(RigRow, RigRow.id == CampaignRow.rig_id)
        .join(LoadStateRow, LoadStateRow.id == PlannedRecordingRow.state_id)
        .outerjoin(JobRow, JobRow.id == PlannedRecordingRow.job_id)
        .where(which)
        .order_by(PlannedRecordingRow.campaign_id, PlannedRecordingRow.position)
    )
    return [Planned(*row) for row in rows]


def put(
    session: Session,
    campaign: str,
    wanted: Sequence[tuple[str, Trigger]],
    by: str,
    now: datetime,
    *,
    ask: bool = False,
    process: bool = False,
    look: Look = NO_LOOK,
) -> None:
    """Plan recordings of states, behind those that are planned; one that is planned gets the new trigger.

    Parameters
    ----------
    wanted
        Labels of states, and what each waits for.
    by
        Who plans it.
    ask, process
        See `recordings.requests`.
    look
        Whether there is to be a quick look at each, and where that holds the plan.

    Raises
    ------
    Conflict
        A state was recorded by the plan, or is just being recorded.
    NotFound
        There is no such campaign or state.
    """
    number = lock(session, campaign)
    there = {one.label: one for one in planned(session, [number])}
    known = state_ids(session, number)
    last = max((one.row.position for one in there.values()), default=0)
    changes.of_recordings(session, campaign, [label for label, _ in wanted], "planned")
    for label, trigger in wanted:
        if label not in known:
            meant = did_you_mean(label, known)
            raise NotFound(
                f"campaign {campaign} has no state {label}; {meant}'sms campaign add-state' adds one"
            )
        values = {"trigger": triggers.as_json(trigger), "ask": ask, "process": process, **_looked_at(look)}
        said = {"planned_at": now, "planned_by": by, "seen": None, "seen_at": None, "note": None}
        found = there.get(label)
        if found is not None and found.row.status not in (Status.PLANNED.value, Status.SKIPPED.value):
            raise Conflict(why_not(found))
        if found is not None and found.row.status == Status.PLANNED.value:
            _change(found.row, revision=found.row.revision + 1, **values, **said)
            continue
        last += 1
        again = {
            "position": last,
            "status": Status.PLANNED.value,
            "held": False,
            "job_id": None,
            "due_at": None,
        }
        if found is not None:
            _change(found.row, revision=found.row.revision + 1, **again, **values, **said)
        else:
            session.add(
                PlannedRecordingRow(
                    campaign_id=number, state_id=known[label], revision=0, **again, **values, **said
                )
            )


def _looked_at(look: Look) -> dict[str, object]:
    """Return what a row keeps of the look that is wanted."""
    limits = [limit.as_json() for limit in look.stop_if]
    return {"look": look.enabled, "stop_if": limits, "awaited": bool(limits), "stopped_by": None}


def set_held(session: Session, campaign: str, labels: Collection[str], held: bool) -> list[str]:
    """Hold some planned recordings back, or the whole plan, or let it go on; return the states that changed.

    One that is held keeps those behind it from beginning, too. Raises as `skip` does.
    """
    number = lock(session, campaign)

    def hold(one: Planned) -> bool:
        if one.row.status != Status.PLANNED.value:
            if labels:
                raise Conflict(why_not(one))
            return False
        changed = one.row.held is not held
        one.row.held = held
        return changed

    if not held:
        session.execute(
            update(PlannedRecordingRow)
            .where(PlannedRecordingRow.campaign_id == number)
            .values(stopped_by=None)
        )

    became = "held" if held else "released"
    changed = _each(session, campaign, labels, hold, became)
    if labels:
        return changed
    levels = planned_levels.set_held(session, number, held)
    changes.of_recordings(session, campaign, levels, became)
    return [*changed, *levels]


def skip(session: Session, campaign: str, labels: Collection[str]) -> list[str]:
    """Leave out some planned recordings, or the next one, and return their states.

    Raises
    ------
    Conflict
        One is recorded, or just being recorded.
    NotFound
        There is no such campaign, or nothing planned of such a state.
    """
    chosen = labels or _next_label(session, campaign)

    def leave_out(one: Planned) -> bool:
        if not one.is_open or (one.job is not None and one.job.state in _RUNS):
            raise Conflict(why_not(one))
        _change(one.row, status=Status.SKIPPED.value, revision=one.row.revision + 1)
        return True

    return _each(session, campaign, chosen, leave_out, "skipped")


def drop(session: Session, campaign: str, labels: Collection[str]) -> Dropped:
    """Forget some recordings of a plan, or all that do not run, and levels; nothing recorded is lost.

    Raises as `skip` does.
    """
    number = lock(session, campaign)
    running: list[str] = []
    recorded: list[str] = []

    def forget(one: Planned) -> bool:
        if one.job is not None and one.job.state in _RUNS:
            if labels:
                raise Conflict(why_not(one))
            running.append(one.label)
            return False
        if one.is_recorded:
            recorded.append(one.label)
        session.delete(one.row)
        return True

    dropped = _each(session, campaign, labels, forget, "dropped")
    forgotten = [label for label in dropped if label not in recorded]
    if not labels:
        levels = planned_levels.drop(session, number)
        changes.of_recordings(session, campaign, levels, "dropped")
        forgotten += levels
    return Dropped(tuple(forgotten), tuple(recorded), tuple(running))


def move(session: Session, campaign: str, label: str, before: str | None) -> None:
    """Let a planned recording come before another one, or last where that is None.

    Raises
    ------
    Conflict
        One of them has already started, or is skipped.
    InvalidInput
        Both are the same.
    NotFound
        There is no such campaign, or nothing planned of such a state.
    """
    if label == before:
        raise InvalidInput(f"{label} cannot come before itself: name another state")
    rows = planned(session, [lock(session, campaign)])
    for name in (label, before):
        if name is None:
            continue
        found = _of(rows, campaign, name)
        if found.row.status != Status.PLANNED.value:
            raise Conflict(why_not(found))
    waiting = [one for one in rows if one.row.status == Status.PLANNED.value]
    positions = [one.row.position for one in waiting]
    moved = _of(waiting, campaign, label)
    order = [one for one in waiting if one is not moved]
    place = len(order) if before is None else [one.label for one in order].index(before)
    order.insert(place, moved)
    changes.of_recordings(session, campaign, [label], "moved")
    for one, position in zip(order, positions, strict=True):
        # What was found to hold for one that is not next any more begins nothing.
        if one.row.position != position:
            _change(one.row, position=position, revision=one.row.revision + 1)


def why_not(one: Planned) -> str:
    """Say what has become of a recording that is not to be changed any more, or not yet again."""
    if one.job is None:
        skipped = one.row.status == Status.SKIPPED.value
        hint = f"; 'sms acquire plan {one.campaign} --state {one.label}' plans it again" if skipped else ""
        return f"{one.label} is {one.row.status}{hint}"
    short, state = one.job.id[:SHORT_ID], one.job.state
    if state is JobState.SUCCEEDED:
        return f"{one.label} is recorded, by job {short}"
    if state in _RUNS:
        return f"{one.label} is being recorded, job {short} is {state.value}; 'sms acquire abort' stops it"
    reason = f" ({one.job.error or one.job.message})" if one.job.error or one.job.message else ""
    became = "needs an operator" if state is JobState.NEEDS_OPERATOR else f"is {state.value}"
    return (
        f"the recording of {one.label} {became}{reason}: 'sms acquire resume {short}' goes on with it, "
        f"'sms acquire plan skip {one.campaign}' without it"
    )


def _each(
    session: Session, campaign: str, labels: Collection[str], change: Callable[[Planned], bool], became: str
) -> list[str]:
    """Change some recordings of a plan, or all, and return and note those to which that is new."""
    number = lock(session, campaign)
    rows = planned(session, [number])
    if labels and planned_levels.are_there(session, number):
        _refuse_next(campaign, labels, planned_levels.next_state(session, number))
    chosen = [_of(rows, campaign, label) for label in labels] if labels else rows
    if not chosen and not planned_levels.are_there(session, number):
        raise NotFound(f"nothing is planned of {campaign}; 'sms acquire plan {campaign} --next' plans all")
    changed = [one.label for one in chosen if change(one)]
    changes.of_recordings(session, campaign, changed, became)
    return changed


def _refuse_next(campaign: str, labels: Collection[str], coming: str) -> None:
    """Raise `NotFound` for the state that levels add next: it is shown, and is none yet."""
    if coming in labels:
        raise NotFound(
            f"{coming} of {campaign} is not there before its load is held: name no state to hold, let go on "
            "or drop the whole plan"
        )


def _next_label(session: Session, campaign: str) -> list[str]:
    number = lock(session, campaign)
    left = [one.label for one in planned(session, [number]) if one.is_open]
    if not left and planned_levels.are_there(session, number):
        raise NotFound(
            f"nothing is left to skip in the plan of {campaign}, whose next state is added once a load is "
            f"held: 'sms acquire plan hold {campaign}' holds it back"
        )
    if not left:
        raise NotFound(f"nothing is left to record by the plan of {campaign}; see 'sms acquire plan show'")
    return left[:1]


def _of(rows: Sequence[Planned], campaign: str, label: str) -> Planned:
    found = next((one for one in rows if one.label == label), None)
    if found is None:
        names = [one.label for one in rows]
        meant = did_you_mean(label, names)
        planned = ", ".join(names) or "none"
        raise NotFound(f"nothing is planned of {campaign}/{label}; {meant}planned are {planned}")
    return found


def lock(session: Session, campaign: str) -> int:
    """Return the number of a campaign, whose plan nobody else changes until this transaction has ended."""
    number = campaign_id(session, campaign)
    session.execute(select(CampaignRow.id).where(CampaignRow.id == number).with_for_update(key_share=True))
    return number


def _change(row: PlannedRecordingRow, **values: object) -> None:
    for name, value in values.items():
        setattr(row, name, value)
