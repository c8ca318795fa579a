"""Backups of catalogue and archive that fit each other, taken while jobs run, and their restoration.

A backup is a folder with `archive`, which every backup into it adds to, and `snapshots`, one catalogue
each. First the catalogue is copied as it stands at one moment, then the files that this copy knows. They are
sealed: complete before the catalogue knew them, and never changed afterwards. So they are what they were at
that moment, however long copying takes and whatever jobs seal meanwhile; and one that an earlier backup has
copied need not be copied again.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import func, select

from sms_jobs.archive import Archive, layout
from sms_jobs.archive.sealing import sync
from sms_jobs.catalogue import copying, schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import FileRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound, StorageFull
from sms_jobs.settings import FILE_NAME

ARCHIVE = "archive"
SNAPSHOTS = "snapshots"

_AT_ONCE = 500
_OF_THE_PLACE = ("database_url", "broker_url", "archive")
"""Settings that name servers and folders, and may hold passwords: a backup has none of them."""


@dataclass(frozen=True)
class Progress:
    """How far a backup or restoration has come.

    Attributes
    ----------
    path
        The file that is done.
    done_bytes, total_bytes
        Of all files, those that were there already included.
    copied
        False when it was there already.
    missing
        Why it could not be copied, or empty.
    """

    path: str
    done_bytes: int
    total_bytes: int
    copied: bool
    missing: str = ""


def snapshots(folder: Path) -> list[Path]:
    """Return the snapshots of a backup, the oldest first."""
    return sorted((folder / SNAPSHOTS).glob("[0-9]*.sqlite"))


def back_up(
    catalogue: Catalogue, archive: Archive, home: Path, folder: Path, now: datetime
) -> Iterator[Progress]:
    """Add a snapshot of the catalogue and the files that it knows to a backup.

    A snapshot gets its name when all its files have been dealt with.

    Raises
    ------
    InvalidInput
        The folder lies in the archive.
    Conflict
        There is a snapshot of this second already.
    StorageFull
        The backup's disk is full; going on later copies only what is not there yet.
    """
    folder = folder.absolute()
    if folder.resolve().is_relative_to(archive.root):
        raise InvalidInput(f"{folder} lies in the archive {archive.root}; give a folder elsewhere")
    snapshot = folder / SNAPSHOTS / f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}.sqlite"
    if snapshot.exists():
        raise Conflict(f"there is a snapshot {snapshot} already; try again in a second")
    growing = snapshot.with_name(f".{snapshot.name}.{os.getpid()}.tmp")
    try:
        with closing(Catalogue(f"sqlite:///{growing}", create=True)) as copy:
            copying.prepare(copy)
            for _ in copying.copy(catalogue, copy, hold=False):
                pass
            yield from _copy_known(copy, archive.root, (folder / ARCHIVE).resolve())
        _keep_settings(home, snapshot.with_suffix(".toml"))
        sync(growing)
        growing.replace(snapshot)
        sync(snapshot.parent)
    except OSError as error:
        raise StorageFull(
            f"the backup in {folder} cannot be written: {error.strerror}; free some space, then give the same"
            " command again"
        ) from error
    finally:
        for left in growing.parent.glob(f"{growing.name}*"):
            left.unlink()


def restore(folder: Path, home: Path, name: str = "") -> Iterator[Progress]:
    """Make an embedded home of a snapshot and the files that it knows.

    Parameters
    ----------
    name
        The beginning of the snapshot's name; the newest if empty.

    Raises
    ------
    NotFound
        There is no such snapshot.
    Conflict
        The home is there and not empty.
    StorageFull
        The disk is full.
    """
    matching = [s for s in snapshots(folder) if s.name.startswith(name)]
    if not matching:
        raise NotFound(f"there is no snapshot '{name}*.sqlite' in {folder / SNAPSHOTS}; 'ls' shows them")
    snapshot = matching[-1]
    if home.exists() and any(home.iterdir()):
        raise Conflict(f"{home} is not empty; give a folder that is not there yet")
    growing = home / f"{snapshot.name}.tmp"
    try:
        home.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(snapshot, growing)
        with closing(Catalogue(f"sqlite:///{growing}")) as catalogue:
            schema.upgrade(catalogue)
            yield from _copy_known(catalogue, (folder / ARCHIVE).resolve(), (home / "archive").resolve())
        settings = snapshot.with_suffix(".toml")
        if settings.is_file():
            shutil.copyfile(settings, home / FILE_NAME)
        sync(growing)
        # Last: a home whose restoration was interrupted has no catalogue, and nothing takes it for whole.
        growing.replace(home / "catalogue.sqlite")
        sync(home)
    except OSError as error:
        raise StorageFull(
            f"{home} cannot be written: {error.strerror}; free some space, remove it and restore again"
        ) from error


def _copy_known(catalogue: Catalogue, source: Path, target: Path) -> Iterator[Progress]:
    """Copy the files that a catalogue knows, and the provenance of its documents, unless they are there."""
    with catalogue.reading() as session:
        total = int(session.scalar(select(func.sum(FileRow.size_bytes))) or 0)
    done, after = 0, 0
    while True:
        query = select(FileRow).where(FileRow.id > after).order_by(FileRow.id).limit(_AT_ONCE)
        with catalogue.reading() as session:
            rows = [(f.id, f.path, f.size_bytes) for f in session.scalars(query)]
        if not rows:
            return
        after = rows[-1][0]
        for _, path, size in rows:
            wanted = [path] if layout.is_dataset(path) else [layout.sidecar(path), path]
            copied, missing = False, ""
            for relative in wanted:
                original, there = layout.inside(source, relative), layout.inside(target, relative)
                if there.is_file() and (relative != path or there.stat().st_size == size):
                    continue
                if not original.is_file():
                    missing = f"{relative} is not in {source}"
                    continue
                _copy_file(original, there)
                copied = True
            done += size
            yield Progress(path, done, total, copied, missing)


def _copy_file(original: Path, copy: Path) -> None:
    copy.parent.mkdir(parents=True, exist_ok=True)
    growing = copy.with_name(f".{copy.name}.{os.getpid()}.tmp")
    try:
        shutil.copyfile(original, growing)
        # With its times and its being read-only.
        shutil.copystat(original, growing)
        sync(growing)
        growing.replace(copy)
        sync(copy.parent)
    finally:
        growing.unlink(missing_ok=True)


def _keep_settings(home: Path, copy: Path) -> None:
    """Keep the home's settings, without those that belong to the place or may hold a password."""
    file = home / FILE_NAME
    if not file.is_file():
        return
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not line.lstrip("# \t\"'").startswith(_OF_THE_PLACE)]
    copy.write_text("".join(kept), encoding="utf-8")
