"""Finds a catalogue that is damaged, emptied or gone, and makes room for a new one; nothing is deleted."""

from __future__ import annotations

import fcntl
import sqlite3
import time
from contextlib import closing
from pathlib import Path

from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError

from sms_jobs.catalogue.database import says_damaged
from sms_jobs.errors import Conflict

_BESIDE = ("", "-wal", "-shm")
"""What SQLite adds to the name of a file for those that belong to it."""
_SHARED_BY_ALL = 128
"""The byte of the last of them on which every open connection holds a lock."""
_STEPS = 10_000
_HEADER = b"SQLite format 3\0"


def file_of(url: str) -> Path | None:
    """Return the file of a catalogue on SQLite; None for one on a server."""
    try:
        parsed = make_url(url)
    except ArgumentError:
        return None
    return Path(parsed.database) if parsed.get_backend_name() == "sqlite" and parsed.database else None


def damage(file: Path, limit_s: float | None = None) -> str | None:
    """Return what is wrong with an SQLite file, in the library's words.

    Parameters
    ----------
    limit_s
        How long it is examined at most; what was not found by then is not reported.
    """
    if not file.is_file() or file.stat().st_size == 0:
        return None
    ends = None if limit_s is None else time.monotonic() + limit_s
    try:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as connection:
            connection.set_progress_handler(lambda: ends is not None and time.monotonic() > ends, _STEPS)
            found = str(connection.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.DatabaseError as error:
        return str(error) if says_damaged(error) else None
    return None if found == "ok" else " ".join(found.split())


def is_other_file(file: Path, home: Path) -> bool:
    """Say whether a file that SQLite cannot read may never have been a catalogue, but was configured as one.

    A file within the home is a catalogue, whatever a disk has made of it.
    """
    if file.absolute().is_relative_to(home.absolute()):
        return False
    with file.open("rb") as stream:
        return stream.read(len(_HEADER)) != _HEADER


def set_aside(file: Path) -> Path:
    """Rename a damaged SQLite file and what belongs to it; return its new name.

    Raises
    ------
    Conflict
        A program has it open and would go on writing to it.
    """
    if _is_open(file):
        raise Conflict(f"the damaged catalogue {file} is in use; end the service, then run this again")
    number = 1
    while (aside := file.with_name(f"{file.name}.damaged-{number}")).exists():
        number += 1
    for ending in _BESIDE:
        part = Path(f"{file}{ending}")
        if part.exists():
            part.replace(f"{aside}{ending}")
    return aside


def _is_open(file: Path) -> bool:
    shared = Path(f"{file}-shm")
    if not shared.exists():
        return False
    with shared.open("r+b") as stream:
        try:
            fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _SHARED_BY_ALL)
        except OSError:
            return True
    return False
