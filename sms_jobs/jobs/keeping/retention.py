"""Which results may go, by policy: those that newer ones have replaced and that nothing kept was made from.

What was measured, calibrations and definitions of campaigns stay for ever. So does whatever is pinned, what
runs name that are kept, and all that a file which stays was computed from, back to what was measured.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session, aliased

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import CalibrationRow, CalibrationUseRow
from sms_jobs.catalogue.tables.checks import FileCheckRow
from sms_jobs.catalogue.tables.files import (
    FileRow,
    PinRow,
    ProvenanceRow,
    ReadingRow,
    ResultRow,
    StatisticRow,
)
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import Conflict, NotFound
from sms_jobs.jobs.asking import runs
from sms_jobs.records.job import JobState

_AT_ONCE = 500


@dataclass(frozen=True)
class Removable:
    """A result that a retention policy removes."""

    file_id: int
    path: str
    kind: str
    size_bytes: int
    created_at: datetime
    job_id: str | None


@dataclass(frozen=True)
class Pin:
    """A file that stays whatever a policy says, and why."""

    file_id: int
    path: str
    reason: str
    pinned_at: datetime


def pin(session: Session, file_id: int, reason: str, now: datetime) -> None:
    """Keep a file; raise `Conflict` when it is pinned already, `NotFound` when it is gone."""
    # Locked, so that nobody lets it go before this is committed.
    if session.get(FileRow, file_id, with_for_update={"read": True, "key_share": True}) is None:
        raise NotFound(
            f"file {file_id} is not in the catalogue any more; 'sms data find' shows those that are"
        )
    if session.get(PinRow, file_id) is not None:
        raise Conflict(f"file {file_id} is pinned already; 'sms data pins' shows why")
    session.add(PinRow(file_id=file_id, reason=reason, pinned_at=now))


def unpin(session: Session, file_id: int) -> None:
    """Let a policy decide about a file again; raise `NotFound` when it is not pinned."""
    row = session.get(PinRow, file_id)
    if row is None:
        raise NotFound(f"file {file_id} is not pinned; 'sms data pins' shows those that are")
    session.delete(row)
    session.flush()


def pins(session: Session) -> list[Pin]:
    """Return all pins, in order of the files' numbers."""
    rows = session.execute(
        select(PinRow, FileRow.path).join(FileRow, FileRow.id == PinRow.file_id).order_by(PinRow.file_id)
    )
    return [Pin(row.file_id, path, row.reason, row.pinned_at) for row, path in rows]


def superseded(session: Session, kinds: Collection[str] = ()) -> list[Removable]:
    """Return the results that a newer one of the same kind, subject and type has replaced, by number.

    Several documents of one job are of different names; one is replaced by one of the same name.
    """
    older, newer = aliased(FileRow), aliased(FileRow)
    query = (
        select(older, ResultRow.kind)
        .join(ResultRow, ResultRow.file_id == older.id)
        .where(
            select(newer.id)
            .where(
                newer.source == older.source,
                newer.campaign_id == older.campaign_id,
                newer.state_id.is_not_distinct_from(older.state_id),
                newer.view.is_not_distinct_from(older.view),
                newer.media_type == older.media_type,
                newer.id > older.id,
                newer.job_id != older.job_id,
            )
            .exists()
        )
        .order_by(older.id)
    )
    if kinds:
        query = query.where(ResultRow.kind.in_(kinds))
    return [
        Removable(file.id, file.path, kind, file.size_bytes, file.created_at, file.job_id)
        for file, kind in session.execute(query)
    ]


def removable(
    session: Session, now: datetime, older_than: timedelta, kinds: Collection[str] = ()
) -> list[Removable]:
    """Return the results that a policy removes: superseded, old, and nothing that stays was made from them.

    Parameters
    ----------
    older_than
        Since a result was made, or last reused.
    kinds
        Only results of these; of all when empty.
    """
    return without_needed(session, _old(session, now, older_than, kinds))


def _old(session: Session, now: datetime, older_than: timedelta, kinds: Collection[str]) -> list[Removable]:
    reused = dict(
        session.execute(
            select(JobRow.reused_from, func.max(JobRow.finished_at))
            .where(JobRow.reused_from.is_not(None))
            .group_by(JobRow.reused_from)
        ).all()
    )
    old = []
    for one in superseded(session, kinds):
        last = max(one.created_at, reused.get(one.job_id) or one.created_at)
        if now - last > older_than:
            old.append(one)
    return old


def without_needed(session: Session, candidates: Iterable[Removable]) -> list[Removable]:
    """Leave out the candidates that are pinned, or that anything which stays was computed from."""
    going = {one.file_id: one for one in candidates}
    kept = set(session.scalars(select(PinRow.file_id)))
    kept.update(session.scalars(select(CalibrationRow.file_id)))
    kept.update(runs.kept_files(session))
    kept.update(_inputs_of_the_unfinished(session))
    inputs: dict[int, list[int]] = {}
    for output, given in session.execute(select(ProvenanceRow.output_id, ProvenanceRow.input_id)):
        inputs.setdefault(output, []).append(given)
    pending = [*kept, *(output for output in inputs if output not in going)]
    seen = set(pending)
    while pending:
        number = pending.pop()
        going.pop(number, None)
        for given in inputs.get(number, ()):
            if given not in seen:
                seen.add(given)
                pending.append(given)
    return list(going.values())


def _inputs_of_the_unfinished(session: Session) -> set[int]:
    """Return what jobs that may still run will open; those that have succeeded will not."""
    unfinished = (
        select(DependencyRow.file_id, DependencyRow.producer_id)
        .join(JobRow, JobRow.id == DependencyRow.job_id)
        .where(JobRow.state != JobState.SUCCEEDED)
        .subquery()
    )
    producer = aliased(JobRow)
    # Which of its producer's files a job needs is noted only when it begins; a reused one has another's.
    made = (
        select(FileRow.id)
        .join(producer, FileRow.job_id == func.coalesce(producer.reused_from, producer.id))
        .join(unfinished, unfinished.c.producer_id == producer.id)
    )
    given = select(unfinished.c.file_id).where(unfinished.c.file_id.is_not(None))
    return {*session.scalars(given), *session.scalars(made)}


def forget(session: Session, files: Collection[int]) -> None:
    """Take files out of the catalogue: their jobs are not reused any more, but stay on record."""
    numbers = sorted(files)
    for start in range(0, len(numbers), _AT_ONCE):
        some = numbers[start : start + _AT_ONCE]
        made_by = select(FileRow.job_id).where(FileRow.id.in_(some))
        session.execute(update(JobRow).where(JobRow.id.in_(made_by)).values(reuse_key=None))
        session.execute(update(DependencyRow).where(DependencyRow.file_id.in_(some)).values(file_id=None))
        session.execute(delete(ProvenanceRow).where(ProvenanceRow.output_id.in_(some)))
    for start in range(0, len(numbers), _AT_ONCE):
        some = numbers[start : start + _AT_ONCE]
        session.execute(delete(ProvenanceRow).where(ProvenanceRow.input_id.in_(some)))
        for table in (StatisticRow, ReadingRow, ResultRow, PinRow, CalibrationUseRow, FileCheckRow):
            session.execute(delete(table).where(table.file_id.in_(some)))
        session.execute(delete(FileRow).where(FileRow.id.in_(some)))


def remove(
    catalogue: Catalogue,
    archive: Archive,
    now: datetime,
    older_than: timedelta,
    kinds: Collection[str] = (),
) -> list[Removable]:
    """Remove the results that a policy does not keep, and return them.

    They are locked before they are looked at for the last time: whoever begins to need one meanwhile is
    either seen, or finds it gone. One that somebody else has locked stays.

    The catalogue forgets them in one transaction before the first file is removed. Killed in between, some
    files are left that the catalogue does not know: 'sms archive verify' names them, nothing that is known
    is missing.
    """
    # Many of those who load this module remove nothing.
    from sms_jobs.jobs.archiving.repository import Repository

    with catalogue.writing() as session:
        chosen = removable(session, now, older_than, kinds)
        locked = _lock(session, [one.file_id for one in chosen])
        old = _old(session, now, older_than, kinds)
        gone = without_needed(session, [one for one in old if one.file_id in locked])
        forget(session, [one.file_id for one in gone])
    repository = Repository(catalogue, archive)
    for one in gone:
        repository.withdraw(one.path)
    return gone


def _lock(session: Session, files: Collection[int]) -> set[int]:
    """Keep everybody from referring to files until the transaction ends; return those that were free."""
    numbers = sorted(files)
    locked: set[int] = set()
    for start in range(0, len(numbers), _AT_ONCE):
        some = FileRow.id.in_(numbers[start : start + _AT_ONCE])
        locked.update(session.scalars(select(FileRow.id).where(some).with_for_update(skip_locked=True)))
    return locked
