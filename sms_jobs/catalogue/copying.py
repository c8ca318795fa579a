"""Copies a catalogue, row for row, from one database to another: SQLite to PostgreSQL, and back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Table as SqlTable
from sqlalchemy import bindparam, func, insert, select, text, update
from sqlalchemy.exc import DataError, IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.every import METADATA, written_tables
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import ConfigurationError, Conflict
from sms_jobs.records.job import ALIVE_WITHIN, JobState
from sms_jobs.records.sizes import number_of

_AT_ONCE = 2000


@dataclass(frozen=True)
class Copied:
    """How far a copy has come: `done` of `total` rows, `table` at work."""

    table: str
    done: int
    total: int


def require_idle(source: Catalogue, now: datetime) -> None:
    """Raise `Conflict` when jobs run or a worker may claim one: it would go on writing to the old catalogue.

    A worker that was killed counts for a minute after its last sign of life.
    """
    with source.reading() as session:
        running = session.scalar(
            select(func.count()).select_from(JobRow).where(JobRow.state == JobState.RUNNING)
        )
        alive = session.scalars(
            select(WorkerRow).where(WorkerRow.draining.is_(False), WorkerRow.beat_at >= now - ALIVE_WITHIN)
        ).all()
    if alive:
        names = ", ".join(f"{w.id} on {w.host} (process {w.pid})" for w in alive)
        raise Conflict(
            f"the service runs: worker {names}; let it end in order (Ctrl-C, or 'systemctl stop'; "
            "jobs that run are finished first), then copy again"
        )
    if running:
        raise Conflict(
            f"workers that give no sign of life have {number_of(running, 'job')} running; start 'sms up', "
            "which recovers what is lost, end it in order, then copy again"
        )


def prepare(target: Catalogue) -> None:
    """Make an empty database ready to be copied to; one that has the schema and no row is ready already.

    Raises
    ------
    Conflict
        There are rows in it.
    ConfigurationError, OtherFormat
        It is another program's, or its schema is not the one that this version works with.
    """
    if schema.current_revision(target) is None:
        schema.upgrade(target)
    schema.require_current(target)
    differences = schema.differences_from_models(target)
    if differences:
        raise ConfigurationError(
            f"the schema of {target.describe()} is not this version's ({differences[0]}); "
            "give an empty database"
        )
    with target.reading() as session:
        for table in written_tables():
            count = session.scalar(select(func.count()).select_from(table))
            if count:
                raise Conflict(
                    f"{target.describe()} is not empty: it has {number_of(count, 'row')} in '{table.name}'; "
                    "give an empty database"
                )


def copy(source: Catalogue, target: Catalogue, *, hold: bool = True) -> Iterator[Copied]:
    """Copy every row to a catalogue that `prepare` has made ready, telling how far it has come.

    What is copied is the source's state at one moment. The target is written in one transaction: it has all
    rows, or, after whatever error, none.

    Parameters
    ----------
    hold
        Let nobody write to the source meanwhile, so that nothing is left behind in it. A snapshot, which is
        not to stop anybody, does without.

    Raises
    ------
    Conflict
        A row cannot be stored in the target, or the target has another number of rows in the end.
    """
    with _at_one_moment(source, hold) as reading, target.writing() as writing:
        tables = written_tables()
        counts = {t.name: reading.scalar(select(func.count()).select_from(t)) or 0 for t in tables}
        total, done = sum(counts.values()), 0
        for table in tables:
            for copied in _copy_table(reading, writing, table):
                done += copied
                yield Copied(table.name, done, total)
            found = writing.scalar(select(func.count()).select_from(table))
            if found != counts[table.name]:
                raise Conflict(
                    f"'{table.name}' has {counts[table.name]} rows in {source.describe()} and {found} in "
                    f"{target.describe()}; nothing was copied, try again"
                )
        if target.dialect == "postgresql":
            set_sequences(writing)


@contextmanager
def _at_one_moment(source: Catalogue, hold: bool) -> Iterator[Session]:
    """Open a session that sees one state of the source however long it reads, and may hold it still."""
    if source.dialect == "sqlite":
        with source.writing() if hold else source.reading() as session:
            yield session
        return
    with source.reading() as session:
        if hold:
            # Before the first query, which fixes what is seen. Writers wait until the session ends.
            names = ", ".join(f'"{table.name}"' for table in METADATA.sorted_tables)
            session.execute(text(f"LOCK TABLE {names} IN SHARE MODE"))
        yield session


def _copy_table(reading: Session, writing: Session, table: SqlTable) -> Iterator[int]:
    """Copy one table in the order of its key; yield the size of each batch."""
    # Rows that refer to rows of their own table may come before them: these columns are filled in afterwards.
    later = [c.name for c in table.columns if any(f.column.table is table for f in c.foreign_keys)]
    key = list(table.primary_key.columns)
    query = select(table).order_by(*key)
    with reading.execute(query.execution_options(yield_per=_AT_ONCE)) as rows:
        for batch in rows.mappings().partitions(_AT_ONCE):
            values = [dict(row) | dict.fromkeys(later) for row in batch]
            _store(writing, insert(table), values, table)
            yield len(values)
    for name in later:
        column = table.columns[name]
        statement = update(table).where(*(k == bindparam(f"key_{k.name}") for k in key))
        statement = statement.values({column: bindparam("new")})
        referring = select(*(k.label(f"key_{k.name}") for k in key), column.label("new"))
        referring = referring.where(column.is_not(None)).execution_options(yield_per=_AT_ONCE)
        with reading.execute(referring) as rows:
            for batch in rows.mappings().partitions(_AT_ONCE):
                _store(writing, statement, [dict(row) for row in batch], table)


def _store(writing: Session, statement: Any, values: list[dict[str, Any]], table: SqlTable) -> None:
    try:
        writing.connection().execute(statement, values)
    except (DataError, IntegrityError) as error:
        reason = str(error.orig).strip().splitlines()[0]
        raise Conflict(
            f"a row of '{table.name}' cannot be stored in the target ({reason}); nothing was copied"
        ) from error


def set_sequences(session: Session) -> None:
    """Let PostgreSQL number new rows after those that brought their numbers with them."""
    for table in written_tables():
        column = table.autoincrement_column
        if column is None:
            continue
        highest = session.scalar(select(func.max(column)))
        if highest is not None:
            sequence = func.pg_get_serial_sequence(f'"{table.name}"', column.name)
            session.execute(select(func.setval(sequence, highest)))
