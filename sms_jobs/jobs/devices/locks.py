"""Devices that one job or person holds at a time: all that are asked for, or none.

A lock of a job holds for as long as that attempt runs, so that it ends with the job however that ends; a lock
of a person ends with its lease. Rows are always locked in the order of the devices' names, so that two who
want the same ones wait for each other and never in a circle. An emergency stop asks nobody.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from importlib import import_module
from typing import Any

from sqlalchemy import ColumnElement, and_, delete, exists, func, or_, select, update
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import JobDeviceRow, LockRow
from sms_jobs.errors import Conflict, DevicesBusy, LeaseLost, NotFound
from sms_jobs.records.job import JobState


@dataclass(frozen=True)
class HeldDevice:
    """A device and who holds it.

    Attributes
    ----------
    device
        Its name.
    job_id, kind, subject
        Of the job, or None.
    holder
        The person or program that holds it in place of a job, or None.
    since
        When it was taken.
    lease_until
        Until when a person holds it; a job, for as long as it runs.
    alive
        Whether it is held at all: a holder that is gone holds nothing.
    """

    device: str
    job_id: str | None
    kind: str | None
    subject: str | None
    holder: str | None
    since: datetime | None
    lease_until: datetime | None
    alive: bool

    def __str__(self) -> str:
        who = (
            f"'{self.holder}'"
            if self.job_id is None
            else f"job {self.job_id[:8]} ({self.kind} {self.subject})"
        )
        until = "" if self.lease_until is None else f", until {self.lease_until.astimezone():%H:%M:%S}"
        since = "" if self.since is None else f" since {self.since.astimezone():%Y-%m-%d %H:%M:%S}"
        return f"{self.device}, which {who} has held{since}{until}"


def acquire(session: Session, names: Collection[str], job_id: str, fence: int, now: datetime) -> None:
    """Take devices for an attempt of a job; those that it holds already stay its own.

    Raises
    ------
    DevicesBusy
        Somebody else holds one of them; then none was taken.
    LeaseLost
        The attempt does not run any more.
    """
    current = select(JobRow.id).where(
        JobRow.id == job_id, JobRow.fence == fence, JobRow.state == JobState.RUNNING
    )
    if names and session.scalar(current) is None:
        raise LeaseLost("a newer attempt has started")
    _take(session, names, now, job_id=job_id, fence=fence, holder=None, lease_until=None)


def acquire_for(
    session: Session, names: Collection[str], holder: str, now: datetime, lease: timedelta
) -> None:
    """Take devices for a person or program that is no job, or renew what it holds, for some time.

    Raises
    ------
    DevicesBusy
        Somebody else holds one of them; then none was taken.
    """
    _take(session, names, now, job_id=None, fence=None, holder=holder, lease_until=now + lease)


def release(session: Session, *, job_id: str | None = None, holder: str | None = None) -> list[str]:
    """Give back all that a job, or a person or program, holds; return the names of the devices."""
    mine = LockRow.job_id == job_id if job_id is not None else LockRow.holder == holder
    return _remove(session, mine)


def release_dead(session: Session, now: datetime) -> list[str]:
    """Forget the locks whose holders are gone; return the names of the devices.

    They hold nothing as it is: this only tidies up. It waits for nobody.
    """
    return _remove(session, ~_alive(now), skip_locked=True)


def release_device(session: Session, device: str, now: datetime) -> HeldDevice:
    """Forget the lock of one device, whose holder is gone.

    Raises
    ------
    NotFound
        There is no such lock.
    Conflict
        Its holder is alive.
    """
    found = [lock for lock in held_devices(session, now) if lock.device == device]
    if not found:
        raise NotFound(f"there is no lock of '{device}'; 'sms lock list' shows them")
    if found[0].alive:
        raise Conflict(f"the device is held: {found[0]}; {_way_out(found[0])}")
    _remove(session, LockRow.device == device)
    return found[0]


def held_devices(session: Session, now: datetime, names: Collection[str] | None = None) -> list[HeldDevice]:
    """Return who holds what, in the order of the devices; locks whose holders are gone are not alive."""
    query = (
        select(LockRow, JobRow.kind, JobRow.subject, _alive(now))
        .outerjoin(JobRow, JobRow.id == LockRow.job_id)
        .where(or_(LockRow.job_id.is_not(None), LockRow.holder.is_not(None)))
        .order_by(LockRow.device)
        .execution_options(populate_existing=True)
    )
    if names is not None:
        query = query.where(LockRow.device.in_(names))
    return [
        HeldDevice(
            lock.device, lock.job_id, kind, subject, lock.holder, lock.taken_at, lock.lease_until, bool(alive)
        )
        for lock, kind, subject, alive in session.execute(query)
    ]


def waits_for_device(now: Any) -> ColumnElement[bool]:
    """Return whether a row of `job` needs a device that somebody else holds."""
    needed = aliased(JobDeviceRow)
    return exists().where(needed.job_id == JobRow.id, LockRow.device == needed.device, _alive(now))


def take_needed(session: Session, job_id: str, fence: int, now: datetime) -> bool:
    """Take what a job that is being claimed needs; False when somebody was faster, and nothing was taken."""
    try:
        acquire(session, devices_of(session, job_id), job_id, fence, now)
    except DevicesBusy:
        return False
    return True


def devices_of(session: Session, job_id: str) -> Sequence[str]:
    """Return the devices that a job has to hold while it runs."""
    return session.scalars(
        select(JobDeviceRow.device).where(JobDeviceRow.job_id == job_id).order_by(JobDeviceRow.device)
    ).all()


def waited_for(session: Session, job_id: str, now: datetime) -> list[HeldDevice]:
    """Return the devices that a job needs and that somebody else holds."""
    return [lock for lock in held_devices(session, now, devices_of(session, job_id)) if lock.alive]


def _take(session: Session, names: Collection[str], now: datetime, **owner: Any) -> None:
    requested = sorted(set(names))
    if not requested:
        return
    dialect = import_module(f"sqlalchemy.dialects.{session.get_bind().dialect.name}")
    # Makes the rows that are missing, as those of free devices, and locks the others, in this order.
    rows = dialect.insert(LockRow.__table__).values([{"device": name} for name in requested])
    session.execute(
        rows.on_conflict_do_update(index_elements=["device"], set_={"device": rows.excluded.device})
    )
    kept = []
    for lock in held_devices(session, now, requested):
        if lock.alive and (lock.job_id, lock.holder) != (owner["job_id"], owner["holder"]):
            raise DevicesBusy(f"a device is in use: {lock}; {_way_out(lock)}")
        if lock.alive:
            kept.append(lock.device)
    new = [name for name in requested if name not in kept]
    for devices, values in ((kept, owner), (new, {**owner, "taken_at": now})):
        if devices:
            session.execute(
                update(LockRow)
                .where(LockRow.device.in_(devices))
                .values(**values)
                .execution_options(synchronize_session=False)
            )


def _way_out(lock: HeldDevice) -> str:
    if lock.job_id is None:
        return "wait until then, or ask who that is"
    return f"wait until it has ended, or 'sms job cancel {lock.job_id[:8]}'"


def _remove(session: Session, which: ColumnElement[bool], *, skip_locked: bool = False) -> list[str]:
    names = session.scalars(
        select(LockRow.device)
        .where(which)
        .order_by(LockRow.device)
        .with_for_update(skip_locked=skip_locked, of=LockRow)
    ).all()
    if names:
        session.execute(
            delete(LockRow).where(LockRow.device.in_(names)).execution_options(synchronize_session=False)
        )
    return list(names)


def _alive(now: Any) -> ColumnElement[bool]:
    """Return whether the holder of a row of `lock` still is one."""
    runs = aliased(JobRow)
    of_job = exists().where(
        runs.id == LockRow.job_id, runs.state == JobState.RUNNING, runs.fence == LockRow.fence
    )
    of_person = and_(LockRow.holder.is_not(None), LockRow.lease_until >= now)
    return func.coalesce(or_(of_job, of_person), False)
