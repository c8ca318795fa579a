"""The catalogue's database: SQLite in a file, or PostgreSQL; both behave alike behind this class."""

from __future__ import annotations

import os
import random
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Dialect, Engine, ExceptionContext, create_engine, event, make_url
from sqlalchemy.exc import (
    ArgumentError,
    DBAPIError,
    DisconnectionError,
    NoSuchModuleError,
    OperationalError,
    StatementError,
)
from sqlalchemy.orm import Session
from sqlalchemy.pool import ConnectionPoolEntry, PoolProxiedConnection

from sms_jobs.catalogue import readable
from sms_jobs.catalogue.deeds import Deed
from sms_jobs.errors import (
    CatalogueBusy,
    CatalogueDamaged,
    CatalogueEmpty,
    CommitInDoubt,
    ConfigurationError,
    Conflict,
    InvalidInput,
    NotAllowed,
    ServerUnreachable,
    SmsError,
    StorageFull,
)

_WRITING = "sms_writing"
_RETURNED = "sms_returned_at"
_READ_ONLY = "25006"
"""PostgreSQL's code for a change that a server which stands by refuses."""
_UNUSABLE = (
    "database_url cannot be used: write sqlite:///PATH or postgresql+psycopg://USER@HOST/NAME (the latter "
    "needs 'pip install sms-jobs[postgresql]')"
)
_TRUSTED_S = 1.0
"""A connection that was in use so lately is taken without asking whether the server is still there."""
_PATIENCE_S = 120.0
"""How long a writer of SQLite waits for its turn; of the others each holds it for some milliseconds."""
_LONGEST_PAUSE_S = 0.02
_PATIENCE_OF_READERS_MS = 30_000
"""A reader waits only while a catalogue is opened after a crash or closed by its last user."""

_NOTICED = {
    "connect_timeout": 8,
    "keepalives": 1,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 20_000,
}
"""A server that cannot be reached any more is noticed within 30 s: by what was sent and not acknowledged for
20 s (in ms above), or, where an answer is awaited, by asking its machine after 10 s, and then every 5 s."""
_SERVERS_NOTICE = (
    "SET tcp_keepalives_idle = 10; SET tcp_keepalives_interval = 5; SET tcp_keepalives_count = 3; "
    "SET tcp_user_timeout = 20000"
)
"""The same the other way round: a host that was cut off must not keep rows locked for hours."""


class Catalogue:
    """Sessions on the catalogue's database.

    Parameters
    ----------
    url
        `sqlite:///path` or `postgresql+psycopg://...`.
    create
        Make the file of an SQLite catalogue, and its folder, when it is not there yet.

    Raises
    ------
    ConfigurationError
        The URL is not one of these, or the file does not exist.
    """

    def __init__(self, url: str, *, create: bool = False) -> None:
        self.engine = _engine(url, create)
        self._writing = self.engine.execution_options(**{_WRITING: True})
        self._reading = self.engine
        if self.dialect == "postgresql":
            # By itself each query would see what was committed before it, and two what was between.
            self._reading = self.engine.execution_options(isolation_level="REPEATABLE READ")
        self._readable = readable.file_to_read(self.engine)
        self._deed: Deed | None = None
        self._noted = False
        self._reads_alone = False

    def for_deed(self, deed: Deed) -> Catalogue:
        """Return this catalogue for something that an actor does: its first change says so in the audit.

        What is done within another deed is part of that.
        """
        if self._deed is not None:
            return self
        noting = copy(self)
        noting._deed, noting._noted, noting._reads_alone = deed, False, False
        return noting

    def for_reading(self) -> Catalogue:
        """Return this catalogue for what changes nothing, unless it is part of a deed."""
        if self._deed is not None:
            return self
        reading = copy(self)
        reading._reads_alone = True
        return reading

    @property
    def dialect(self) -> str:
        """Either sqlite or postgresql."""
        return self.engine.dialect.name

    def describe(self) -> str:
        """Return the URL without its password, and without options, one of which may be a password too."""
        return self.engine.url.set(query={}).render_as_string(hide_password=True)

    @property
    def may_write(self) -> bool:
        """Whether this is not a catalogue for reading, and this account may do more than read it."""
        return not self._reads_alone and self._readable is None

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Open a session that sees one consistent state and writes nothing."""
        with (
            self._explained(),
            readable.unchanged(self._readable),
            Session(self._reading, expire_on_commit=False) as session,
        ):
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Open a session that is committed at the end, or rolled back on an exception.

        On SQLite the write lock is taken at once, so that nothing read inside can be changed by another
        process before it is written back. Others wait meanwhile: what takes long, such as loading kinds or
        files, is done before.

        Raises
        ------
        NotAllowed
            This is a catalogue for reading.
        CatalogueBusy
            On SQLite others have been writing all the time.
        CommitInDoubt
            The server went away while it committed.
        """
        if self._reads_alone:
            raise NotAllowed("something that was declared to read alone tried to change the catalogue")
        if self._readable is not None:
            raise Conflict(
                f"this account may only read the catalogue {self.describe()}; do this as its owner"
            )
        with self._explained(), Session(self._writing, expire_on_commit=False) as session:
            changes = _Changes(session) if self._deed is not None and not self._noted else None
            yield session
            session.flush()
            if self._deed is not None and changes is not None and changes.some:
                # Which commands that only read do not load.
                from sms_jobs.catalogue import audit

                audit.append(session, self._deed, datetime.now(UTC))
            try:
                session.commit()
                self._noted = self._noted or (changes is not None and changes.some)
            except DBAPIError as error:
                if not error.connection_invalidated:
                    raise
                raise CommitInDoubt(
                    f"the connection to the catalogue {self.describe()} broke while something was being "
                    "written, which may be there or not; run 'sms doctor'"
                ) from error

    def keep_pages(self, kilobytes: int) -> None:
        """Let each connection to SQLite that is opened from now on keep at most so much of the file."""
        if self.dialect == "sqlite":
            statement = f"PRAGMA cache_size = {-kilobytes}"
            event.listen(self.engine, "connect", lambda connection, _: connection.execute(statement).close())

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    def damaged(self, reason: str) -> CatalogueDamaged:
        """Return what says that the catalogue cannot be used any more, and how to get another."""
        return CatalogueDamaged(
            f"the catalogue {self.describe()} is damaged ({reason}); if database_url is right, end the "
            "service, then restore a backup, or run 'sms archive reindex', which makes a new one from the "
            "archive's files"
        )

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except OperationalError as error:
            reason = str(error.orig).strip().splitlines()[0]
            if says_damaged(error.orig):
                raise self.damaged(reason) from error
            if "disk is full" in reason or "No space left" in reason:
                raise StorageFull(
                    f"the catalogue {self.describe()} cannot be written: the disk is full; free some space"
                ) from error
            raise ServerUnreachable(
                f"the catalogue {self.describe()} does not answer ({reason}); run 'sms doctor'"
            ) from error
        except DBAPIError as error:
            if says_damaged(error.orig):
                raise self.damaged(str(error.orig)) from error
            if error.statement is None and not error.connection_invalidated:
                # It was not even connected; the driver's words may repeat the URL and so a password.
                raise ConfigurationError(_UNUSABLE) from error
            if getattr(error.orig, "sqlstate", None) == _READ_ONLY:
                raise ServerUnreachable(
                    f"the catalogue {self.describe()} takes no changes for now: its server stands by for "
                    "another, or was made read-only; run 'sms doctor'"
                ) from error
            if not error.connection_invalidated:
                raise
            raise ServerUnreachable(
                f"the connection to the catalogue {self.describe()} broke; run 'sms doctor'"
            ) from error
        except StatementError as error:
            # Raised by the type of a column, of a value that it does not take.
            if isinstance(error.orig, SmsError):
                raise error.orig from error
            raise


class _Changes:
    """Whether a session has changed any row."""

    def __init__(self, session: Session) -> None:
        self.some = False
        event.listen(session.connection(), "after_cursor_execute", self._look)

    def _look(
        self, _connection: Any, cursor: Any, _statement: Any, _given: Any, context: Any, _many: Any
    ) -> None:
        if context.isinsert or context.isupdate or context.isdelete:
            self.some = self.some or cursor.rowcount != 0


def says_damaged(error: BaseException | None) -> bool:
    """Say whether an error of SQLite means that its file is damaged, or none of its files."""
    code = getattr(error, "sqlite_errorcode", 0)
    return code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def _engine(url: str, create: bool) -> Engine:
    try:
        parsed = make_url(url)
        backend = parsed.get_backend_name()
        if backend == "sqlite":
            if parsed.query:
                raise ConfigurationError(
                    "database_url of SQLite takes no options: leave out what is behind '?'"
                )
            path = _required_file(parsed.database, create)
            if path.exists() and not os.access(path, os.W_OK):
                return readable.engine_to_read(parsed, path)
            engine = create_engine(parsed, connect_args={"timeout": _PATIENCE_OF_READERS_MS / 1e3})
            event.listen(engine, "connect", _prepare_sqlite)
            event.listen(engine, "begin", _begin_sqlite)
            event.listen(engine, "handle_error", _refuse_value)
            return engine
        if backend == "postgresql":
            # What the URL says wins.
            noticed = {name: value for name, value in _NOTICED.items() if name not in parsed.query}
            engine = create_engine(parsed, connect_args=noticed)
            event.listen(engine, "connect", _prepare_postgresql)
            event.listen(engine, "checkin", _note_return)
            event.listen(engine, "checkout", partial(_refuse_broken, engine.dialect))
            event.listen(engine, "handle_error", _refuse_value)
            return engine
    except (ArgumentError, NoSuchModuleError, ModuleNotFoundError, ValueError) as error:
        # The text of the error may repeat the URL and so a password: it is not passed on.
        raise ConfigurationError(_UNUSABLE) from error
    raise ConfigurationError(
        "database_url names another database; the catalogue runs on sqlite or postgresql"
    )


def _refuse_value(context: ExceptionContext) -> None:
    """Raise `InvalidInput` for a value that no column can hold, whatever the driver calls that."""
    error = context.original_exception
    data_error = context.dialect.loaded_dbapi.DataError
    if context.statement is not None and isinstance(error, data_error | OverflowError | UnicodeError):
        raise InvalidInput(
            "a number or text that was given is more than the catalogue can hold "
            f"({str(error).splitlines()[0][:100]}); give another"
        ) from error


def _required_file(database: str | None, create: bool) -> Path:
    if not database:
        raise ConfigurationError("database_url must name a file, like sqlite:////var/sms/catalogue.sqlite")
    path = Path(database)
    try:
        if create:
            path.parent.mkdir(parents=True, exist_ok=True)
        there = os.path.lexists(path)
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"the catalogue's folder {path.parent} cannot be made: {getattr(error, 'strerror', error)}; "
            "choose another home"
        ) from error
    if there and not path.is_file():
        raise ConfigurationError(f"the catalogue {path} is a folder or a device, not a file; choose another")
    if not create and not there:
        raise CatalogueEmpty(f"there is no catalogue at {path}; run 'sms init'")
    if not create and path.stat().st_size == 0:
        # To open it would make it a database.
        raise CatalogueEmpty(f"the catalogue {path} is empty; run 'sms init'")
    return path


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    # The driver would begin transactions late and by itself; `_begin_sqlite` does it instead.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout = {_PATIENCE_OF_READERS_MS}")
    cursor.execute("PRAGMA journal_mode = WAL")
    cursor.execute("PRAGMA synchronous = FULL")
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()


def _prepare_postgresql(connection: Any, _record: Any) -> None:
    with connection.cursor() as cursor:
        cursor.execute(_SERVERS_NOTICE)
    connection.commit()


def _note_return(_connection: Any, record: ConnectionPoolEntry) -> None:
    record.info[_RETURNED] = time.monotonic()


def _refuse_broken(
    dialect: Dialect, connection: Any, record: ConnectionPoolEntry, _proxy: PoolProxiedConnection
) -> None:
    """Make the pool open another connection where one that lay idle has been broken since."""
    # Asked before every transaction, this would be a sixth of what a job costs.
    returned = record.info.get(_RETURNED)
    if returned is None or time.monotonic() - returned < _TRUSTED_S:
        return
    try:
        dialect.do_ping(connection)
    except dialect.loaded_dbapi.Error as error:
        raise DisconnectionError from error


def _begin_sqlite(connection: Connection) -> None:
    if connection.get_execution_options().get(_WRITING, False):
        _take_turn(connection)
    else:
        connection.exec_driver_sql("BEGIN")


def _take_turn(connection: Connection) -> None:
    """Begin to write, once nobody else does.

    SQLite's own waiting asks ten times a second and gives up early: among many who write for some
    milliseconds each, whoever waits long meets another one every time. Asked more often, at random moments,
    everybody comes to his turn.
    """
    driver: Any = connection.connection.dbapi_connection
    deadline = time.monotonic() + _PATIENCE_S
    pause = 1e-3
    driver.execute("PRAGMA busy_timeout = 0")
    try:
        while _is_busy(driver):
            if time.monotonic() > deadline:
                raise CatalogueBusy(
                    f"others have written to the catalogue {connection.engine.url} for {_PATIENCE_S:.0f} s; "
                    "nothing was changed; try again, and if it stays so run 'sms doctor'"
                )
            time.sleep(random.uniform(0.5, 1.5) * pause)  # noqa: S311 - chance that keeps no secret
            pause = min(2.0 * pause, _LONGEST_PAUSE_S)
    finally:
        driver.execute(f"PRAGMA busy_timeout = {_PATIENCE_OF_READERS_MS}")
    if not driver.in_transaction:
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def _is_busy(driver: Any) -> bool:
    """Try to begin to write; True where somebody else does. Any other error is for the next try to tell."""
    try:
        driver.execute("BEGIN IMMEDIATE")
    except sqlite3.OperationalError as error:
        return error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY
    return False
