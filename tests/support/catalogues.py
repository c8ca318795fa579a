"""Databases of a test's own: empty, or with the newest schema, which is migrated once and then copied."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from sqlalchemy import Engine, text

from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue

_STRATEGIES_SINCE = (15,)


@contextmanager
def database(server: Engine, template: str = "template1") -> Iterator[str]:
    """Make a database of its own as a copy of another, and give its URL; afterwards it is dropped.

    `server` commits each statement by itself.
    """
    name = f"sms_test_{uuid.uuid4().hex}"
    with server.connect() as connection:
        # Block by block through the log, which is the default, takes four times as long in memory.
        known = (server.dialect.server_version_info or ()) >= _STRATEGIES_SINCE
        strategy = " STRATEGY file_copy" if known else ""
        connection.execute(text(f"CREATE DATABASE {name} TEMPLATE {template}{strategy}"))
    try:
        yield server.url.set(database=name).render_as_string(hide_password=False)
    finally:
        with server.connect() as connection:
            # FORCE ends what a worker that was killed on purpose has left connected.
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))


def migrate(url: str) -> None:
    """Give an empty database, or a file that is not there yet, the newest schema."""
    with closing(Catalogue(url, create=True)) as catalogue:
        schema.upgrade(catalogue)


def migrated_file(folder: Path) -> Path:
    """Return a catalogue with the newest schema in one file that nobody has open, to be copied."""
    file = folder / "catalogue.sqlite"
    migrate(f"sqlite:///{file}")
    assert [path.name for path in folder.iterdir()] == [file.name], "what was written is not in the file yet"
    return file
