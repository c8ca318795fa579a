"""What is told of plans of recordings: what comes next of each, and what it waits for."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.campaigns import campaign_id
from sms_jobs.catalogue.tables.planned import PlannedLevelsRow, PlannedRecordingRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.recording import planned_levels
from sms_jobs.jobs.recording.planned_levels import PlannedLevels
from sms_jobs.jobs.recording.planned_recordings import OPEN, Planned, planned, why_not
from sms_jobs.kinds.kind import rig_queue
from sms_jobs.records import triggers
from sms_jobs.records.gauge_limits import GaugeLimit
from sms_jobs.records.job import ALIVE_WITHIN, JobState
from sms_jobs.records.shown.planned_recordings import PlannedRecording, Status
from sms_jobs.records.triggers import Every, Trigger

_RECORDED = Status.RECORDED.value


def list_planned(session: Session, now: datetime, campaign: str | None = None) -> list[PlannedRecording]:
    """Return the plan of a campaign, or every plan with something left to record.

    Parameters
    ----------
    now
        With time zone; what waits for a time says how long.

    Raises `NotFound` where there is no such campaign.
    """
    if campaign is None:
        of_rows = select(PlannedRecordingRow.campaign_id).where(OPEN)
        numbers = set(session.scalars(of_rows.union(select(PlannedLevelsRow.campaign_id))))
    else:
        numbers = {campaign_id(session, campaign)}
    rows, levels = planned(session, numbers), planned_levels.planned_levels(session, numbers)
    following: dict[int, Planned] = {}
    for one in rows:
        if one.is_open:
            following.setdefault(one.row.campaign_id, one)
    served = _served(session, now) if following or levels else set()
    found = []
    for number in sorted(numbers):
        own = [one for one in rows if one.row.campaign_id == number]
        found += [_shown(one, own, served, following.get(number) is one) for one in own]
        found += [
            _shown_levels(session, one, own, served, number not in following)
            for one in levels
            if one.row.campaign_id == number
        ]
    return found


def _served(session: Session, now: datetime) -> set[str]:
    """Return the queues that a living worker serves."""
    alive = select(WorkerRow.queues).where(
        WorkerRow.beat_at >= now - ALIVE_WITHIN, WorkerRow.draining.is_(False)
    )
    return {queue for queues in session.scalars(alive) for queue in queues.split(",")}


def _unserved(rig: str, served: Collection[str]) -> str:
    queue = rig_queue(rig)
    return "" if queue in served else f"; no worker serves {queue}: start 'sms up' on the host of the rig"


def _shown(one: Planned, rows: Sequence[Planned], served: Collection[str], is_next: bool) -> PlannedRecording:
    row, trigger = one.row, triggers.from_json(one.row.trigger)
    due = max((r.row.due_at for r in rows if r.row.due_at is not None), default=None)
    unserved = _unserved(one.rig, served)

    def waits_for(seen: float | None) -> str:
        return _waits_for(one, trigger, due, rows, seen) + unserved if is_next else ""

    return PlannedRecording(
        one.campaign,
        one.label,
        str(trigger),
        _status(one),
        is_next,
        waits_for(row.seen),
        waits_for(None),
        row.due_at,
        row.seen,
        row.seen_at,
        row.job_id,
        row.planned_by,
        row.note or "",
        tuple(str(GaugeLimit.from_json(kept)) for kept in row.stop_if),
        row.stopped_by or "",
    )


def _status(one: Planned) -> str:
    if one.job is not None and one.row.status == Status.BEGUN.value:
        return Status.RECORDED.value if one.job.state is JobState.SUCCEEDED else one.job.state.value
    return "held" if one.row.held and one.row.status == Status.PLANNED.value else one.row.status


def _waits_for(
    one: Planned, trigger: Trigger, before: datetime | None, rows: Sequence[Planned], seen: float | None
) -> str:
    """Say what keeps the next of a plan from being recorded; with what its channel read, where given."""
    if one.job is not None:
        return why_not(one)
    kept = _kept_back(one.campaign, one.row.held, rows)
    if kept:
        return kept
    words = f"waits for its time: {trigger}"
    if isinstance(trigger, Every):
        due = trigger.next_time(before)
        words = "it is due" if due is None else f"is due at {due.astimezone():%Y-%m-%d %H:%M:%S}"
    elif not isinstance(trigger, triggers.InTurn):
        words = f"waits for {trigger}" + ("" if seen is None else f"; it read {seen:g} last")
    return f"{words}; {one.row.note}" if one.row.note else words


def _kept_back(campaign: str, held: bool, rows: Sequence[Planned]) -> str:
    """Say who or what keeps a plan from going on; empty where nothing does."""
    if held:
        why = next((f": {each.row.stopped_by}" for each in rows if each.row.stopped_by), "")
        return f"it is held back{why}; 'sms acquire plan go {campaign}' lets it go on"
    looked = next((each.label for each in rows if each.row.awaited and each.row.status == _RECORDED), None)
    if looked is not None:
        return f"waits for the quick look at {looked}; 'sms acquire plan show {campaign}' describes it"
    return ""


def _shown_levels(
    session: Session, one: PlannedLevels, rows: Sequence[Planned], served: Collection[str], is_next: bool
) -> PlannedRecording:
    """Return the next state that levels add, as if it were there."""
    row, levels = one.row, one.levels
    last = planned_levels.last_level(session, one)
    unserved = _unserved(one.rig, served)

    def waits_for(seen: float | None) -> str:
        if not is_next:
            return ""
        words = _kept_back(one.campaign, row.held, rows)
        if not words:
            but = "" if last is None else f", but not {last:g} {row.unit} again"
            words = f"waits for {levels}{but}" + ("" if seen is None else f"; it read {seen:g} last")
            words += f"; {row.note}" if row.note else ""
        return words + unserved

    return PlannedRecording(
        one.campaign,
        planned_levels.next_state(session, row.campaign_id),
        str(levels),
        "held" if row.held else Status.PLANNED.value,
        is_next,
        waits_for(row.seen),
        waits_for(None),
        None,
        row.seen,
        row.seen_at,
        None,
        row.planned_by,
        row.note or "",
        tuple(str(GaugeLimit.from_json(kept)) for kept in row.stop_if),
        "",
        is_added=True,
    )
