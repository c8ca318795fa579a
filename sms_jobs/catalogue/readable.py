"""A catalogue in an SQLite file that this account may read and not write.

While somebody has it open for writing, SQLite reads along by way of the files beside it. Where nobody has,
there are none, and an account that may not make them reads the file as it is; should a service begin
meanwhile, what was read is not passed on.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import URL, Engine, create_engine, event
from sqlalchemy.pool import NullPool

from sms_jobs.errors import ServerUnreachable

_PATIENCE_S = 30.0
_FILE = "sms_readable_file"


def engine_to_read(url: URL, path: Path) -> Engine:
    """Return an engine that decides with each connection how the file can be read."""
    engine = create_engine(
        url, creator=partial(_connected, path), poolclass=NullPool, execution_options={_FILE: path}
    )
    event.listen(engine, "connect", _leave_transactions_to_us)
    event.listen(engine, "begin", lambda connection: connection.exec_driver_sql("BEGIN"))
    return engine


def file_to_read(engine: Engine) -> Path | None:
    """Return the file of an engine of this module; None for any other."""
    found: Path | None = engine.get_execution_options().get(_FILE)
    return found


@contextmanager
def unchanged(path: Path | None) -> Iterator[None]:
    """Raise `ServerUnreachable` when a file that was read as it is has been changed inside."""
    before = None if path is None or _log(path).exists() else _state(path)
    yield
    if path is not None and before is not None and (_log(path).exists() or _state(path) != before):
        raise ServerUnreachable(
            f"the catalogue {path} was opened by the service while it was read; run this again"
        )


def _state(path: Path) -> tuple[int, int]:
    about = path.stat()
    return about.st_mtime_ns, about.st_size


def _log(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def _connected(path: Path) -> sqlite3.Connection:
    how = "mode=ro" if _log(path).exists() else "mode=ro&immutable=1"
    name = quote(os.fsencode(path.absolute()))
    return sqlite3.connect(f"file:{name}?{how}", uri=True, timeout=_PATIENCE_S, check_same_thread=False)


def _leave_transactions_to_us(connection: Any, _record: Any) -> None:
    connection.isolation_level = None
