"""Rigs whose channels are watched for planned recordings: held by one watcher, given up to whoever waits."""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.planned import PlannedRecordingRow
from sms_jobs.catalogue.tables.queues import JobDeviceRow, QueueRow
from sms_jobs.jobs.devices import locks
from sms_jobs.kinds.kind import rig_queue
from sms_jobs.records.job import SHORT_ID, JobState
from sms_jobs.records.shown.planned_recordings import Status


def comes_first(session: Session, rig: str, now: datetime, holder: str) -> str | None:
    """Say for whom a watcher has to wait, or to let go of a rig; None where it may watch."""
    device = rig_queue(rig)
    for lock in locks.held_devices(session, now, [device]):
        if lock.alive and lock.holder != holder:
            return f"waits for {lock}"
    if session.scalar(select(QueueRow.paused_at).where(QueueRow.name == device)) is not None:
        return f"the queue {device} is paused: 'sms queue resume {device}' lets it go on"
    queued = session.execute(
        select(JobRow.id, JobRow.kind, JobRow.subject)
        .join(JobDeviceRow, JobDeviceRow.job_id == JobRow.id)
        .where(JobDeviceRow.device == device, JobRow.state == JobState.QUEUED)
        .limit(1)
    ).one_or_none()
    if queued is None:
        return None
    return f"job {queued.id[:SHORT_ID]} ({queued.kind} {queued.subject}) comes first"


def hold(session: Session, rig: str, holder: str, now: datetime, lease: timedelta) -> None:
    """Hold a rig to watch its channels, or go on; raise `DevicesBusy` where somebody else holds it."""
    locks.acquire_for(session, [rig_queue(rig)], holder, now, lease)


def let_go(session: Session, holder: str) -> None:
    """Give a rig back."""
    locks.release(session, holder=holder)


def note_reading(session: Session, row_id: int, seen: float | None, now: datetime) -> None:
    """Note what the channel of a planned recording read just now, and that nothing keeps it from that."""
    values = {"seen": seen, "seen_at": now, "note": None}
    session.execute(update(PlannedRecordingRow).where(PlannedRecordingRow.id == row_id).values(**values))


def note(session: Session, row_id: int, words: str) -> None:
    """Note what keeps a planned recording from being watched, or from beginning, while it has not started."""
    session.execute(
        update(PlannedRecordingRow)
        .where(PlannedRecordingRow.id == row_id, PlannedRecordingRow.status == Status.PLANNED.value)
        .values(note=words)
    )
