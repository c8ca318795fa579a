"""Backups of catalogue and archive that fit each other, taken while jobs run, and their restoration.

A backup is a folder with `archive`, which every backup into it adds to, `snapshots`, one catalogue each, and
`hosts`, the files of rigs and the frames on their way to the archive of each host that backs up. First those
are copied, then the catalogue as it is at one moment, then the files that this copy knows. They are
sealed: complete before the catalogue knew them, and never changed afterwards. So they are what they were at
that moment, however long copying takes and whatever jobs seal meanwhile; and frames that a job archives
meanwhile are in the copy of the folder, or the catalogue knows their file.

A file is compared with what is on record when it is copied. Of those copied before, every backup reads a
share again, in the archive and in the backup, so that after some backups all have been.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zlib import crc32

from pydantic import SecretStr
from sqlalchemy import func, select

from sms_jobs.archive import Archive, FolderStore, layout
from sms_jobs.archive.sealing import sync
from sms_jobs.catalogue import copying, schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.errors import ArchiveCorrupt, Conflict, InvalidInput, NotFound, OtherFormat, StorageFull
from sms_jobs.jobs.keeping import host_folders
from sms_jobs.settings import FILE_NAME, Settings

ARCHIVE = "archive"
SNAPSHOTS = "snapshots"
HOSTS = "hosts"
SHARES = 30
"""In how many backups everything that was copied before is read again, unless it is said otherwise."""

_AT_ONCE = 500
_ROUND = "round.json"
_FOLDERS = ("archive", "spool")
_UNREADABLE = {errno.EIO, errno.ESTALE, errno.EACCES, errno.EPERM}


@dataclass(frozen=True)
class Progress:
    """How far a backup or restoration has come.

    Attributes
    ----------
    path
        The file that is done.
    done_bytes, total_bytes
        Of all files of the archive, those that were there already included.
    copied
        False when it was there already, or could not be copied.
    read_again
        True when it was there already and was compared with what is on record.
    finding
        What is wrong with it and what was done about that; empty when nothing is.
    """

    path: str
    done_bytes: int
    total_bytes: int
    copied: bool
    read_again: bool = False
    finding: str = ""


@dataclass(frozen=True)
class Share:
    """Which of the files that are there already are read again: every `of`th, from the `number`th on."""

    number: int
    of: int

    def has(self, key: int) -> bool:
        """Say whether a file belongs to it, by its number in the catalogue or some other."""
        return key % self.of == self.number % self.of


_NOTHING = Share(-1, 1 << 62)


def snapshots(folder: Path) -> list[Path]:
    """Return the snapshots of a backup, the oldest first."""
    return sorted((folder / SNAPSHOTS).glob("[0-9]*.sqlite"))


def back_up(
    catalogue: Catalogue,
    archive: Archive,
    settings: Settings,
    folder: Path,
    now: datetime,
    shares: int = SHARES,
) -> Iterator[Progress]:
    """Add a snapshot of the catalogue, and the files that it knows, to a backup.

    A snapshot gets its name when all its files have been dealt with. A good file takes the place of a copy
    that is not what was sealed; one that is not itself never comes into the backup.

    Parameters
    ----------
    shares
        In how many backups everything is read again; 1 for all of it now.

    Raises
    ------
    InvalidInput
        The folder is inside the archive.
    Conflict
        There is a snapshot of this second already.
    StorageFull
        The backup's disk is full; going on later copies only what is not there yet.
    """
    folder = folder.absolute()
    if folder.resolve().is_relative_to(settings.archive_root.resolve()):
        raise InvalidInput(f"{folder} is inside the archive {archive.where}; give a folder elsewhere")
    snapshot = folder / SNAPSHOTS / f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}.sqlite"
    if snapshot.exists():
        raise Conflict(f"there is a snapshot {snapshot} already; try again in a second")
    growing = snapshot.with_name(f".{snapshot.name}.{os.getpid()}.tmp")
    here, kept = (
        folder / HOSTS / socket.gethostname(),
        {"rigs": settings.rig_folder, "spool": settings.spool_folder},
    )
    try:
        share = Share(_round(folder), shares)
        for one in host_folders.copy_folders(kept, here, lambda path: share.has(crc32(path.encode()))):
            yield Progress(str(here / one.path), 0, 0, one.copied, finding=one.finding)
        with closing(Catalogue(f"sqlite:///{growing}", create=True)) as copy:
            copying.prepare(copy)
            for _ in copying.copy(catalogue, copy, hold=False):
                pass
            yield from _copy_known(copy, archive, Archive(FolderStore(folder / ARCHIVE)), share)
        _keep_settings(settings.home, snapshot.with_suffix(".toml"))
        sync(growing)
        growing.replace(snapshot)
        sync(snapshot.parent)
        # Now that their frames are in the archive's copy.
        host_folders.forget_gone(kept, here)
        _note_round(folder, share.number + 1)
    except OSError as error:
        raise StorageFull(
            f"the backup in {folder} cannot be written: {error.strerror}; free some space, then give the same"
            " command again"
        ) from error
    finally:
        for left in growing.parent.glob(f"{growing.name}*"):
            left.unlink()


def _round(folder: Path) -> int:
    """Return how many backups have ended: which share is next."""
    file = folder / _ROUND
    return int(json.loads(file.read_bytes())["backups"]) if file.is_file() else 0


def _note_round(folder: Path, backups: int) -> None:
    growing = folder / f".{_ROUND}.tmp"
    growing.write_text(json.dumps({"backups": backups}), encoding="utf-8")
    growing.replace(folder / _ROUND)


def restore(folder: Path, home: Path, name: str = "", host: str = "") -> Iterator[Progress]:
    """Make an embedded home of a snapshot and the files that it knows.

    The files of a host's rigs, and the frames that it had not archived yet, come along as the last backup
    found them.

    Parameters
    ----------
    name
        The beginning of the snapshot's name; the newest if empty.
    host
        Whose rigs and frames; of the host that backed up, or of this one where several did, if empty.

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
    of_host = _host(folder, host)
    growing = home / f"{snapshot.name}.tmp"
    try:
        (home / "archive").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(snapshot, growing)
        with closing(Catalogue(f"sqlite:///{growing}")) as catalogue:
            schema.upgrade(catalogue)
            yield from _copy_known(
                catalogue,
                Archive(FolderStore(folder / ARCHIVE)),
                Archive(FolderStore(home / "archive")),
                _NOTHING,
            )
        for one in [] if of_host is None else host_folders.restore_folders(of_host, home):
            yield Progress(one.path, 0, 0, one.copied, finding=one.finding)
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


def _host(folder: Path, name: str) -> Path | None:
    """Return the folder of one host in a backup; None where no host has any, or none of several is meant."""
    hosts = sorted(path.name for path in (folder / HOSTS).glob("*") if path.is_dir())
    if name and name not in hosts:
        raise NotFound(f"{folder} has no folder of a host {name}; it has {', '.join(hosts) or 'none'}")
    mine = name or (hosts[0] if len(hosts) == 1 else socket.gethostname())
    return folder / HOSTS / mine if mine in hosts else None


def _copy_known(catalogue: Catalogue, source: Archive, target: Archive, share: Share) -> Iterator[Progress]:
    """Copy the files that a catalogue knows unless they are there; of those, read a share again."""
    with catalogue.reading() as session:
        total = int(session.scalar(select(func.sum(FileRow.size_bytes))) or 0)
    done, after = 0, 0
    while True:
        query = select(FileRow).where(FileRow.id > after).order_by(FileRow.id).limit(_AT_ONCE)
        with catalogue.reading() as session:
            rows = list(session.scalars(query))
        if not rows:
            return
        after = rows[-1].id
        for row in rows:
            done += row.size_bytes
            there, again = _is_there(target, row), share.has(row.id)
            if there and not again:
                copied, finding = False, _at_a_glance(source, row)
            else:
                copied, finding = _brought(row, source, target, there)
            yield Progress(row.path, done, total, copied, there and again, finding)


def _is_there(archive: Archive, row: FileRow) -> bool:
    paths = [row.path] if layout.is_dataset(row.path) else [row.path, layout.sidecar(row.path)]
    sizes = [archive.size(path) for path in paths]
    return None not in sizes and sizes[0] == row.size_bytes


def _at_a_glance(archive: Archive, row: FileRow) -> str:
    if _is_there(archive, row):
        return ""
    return f"{row.path} is missing or cut short (in {archive.where}); its copy is there"


def _brought(row: FileRow, source: Archive, target: Archive, there: bool) -> tuple[bool, str]:
    """Copy a file, or compare both that are there; return whether it was copied, and what is wrong."""
    rotten = _fault(target, row) if there else ""
    if there and not rotten:
        fault = _fault(source, row)
        return False, f"{fault} (in {source.where}); the copy in {target.where} is good" if fault else ""
    try:
        target.bring(row, source)
    except (ArchiveCorrupt, OtherFormat) as error:
        also = f", and the copy in {target.where} is damaged too" if rotten else ""
        return False, f"{error} (in {source.where}){also}"
    except OSError as error:
        if error.errno not in _UNREADABLE:
            raise
        return False, f"{row.path} cannot be read: {error.strerror} (in {source.where})"
    return True, f"the copy of {row.path} was damaged and is replaced" if rotten else ""


def _fault(archive: Archive, row: FileRow) -> str:
    """Say what is wrong with a file of which all is read; empty when nothing is."""
    try:
        archive.verify_bytes(row)
        if not layout.is_dataset(row.path):
            archive.verify_provenance(row.path, row.content_hash)
    except (ArchiveCorrupt, OtherFormat) as error:
        return str(error)
    except OSError as error:
        if error.errno not in _UNREADABLE:
            raise
        return f"{row.path} cannot be read: {error.strerror}"
    return ""


def _keep_settings(home: Path, copy: Path) -> None:
    """Keep the home's settings, without secrets and what belongs to the place; comments may hold both."""
    file = home / FILE_NAME
    if not file.is_file():
        return
    settings = tomllib.loads(file.read_text(encoding="utf-8"))
    secret = {name for name, field in Settings.model_fields.items() if field.annotation is SecretStr}
    kept = {name: value for name, value in settings.items() if name not in secret and name not in _FOLDERS}
    copy.write_text("".join(_settings_lines(kept)), encoding="utf-8")


def _settings_lines(settings: Mapping[str, Any]) -> Iterator[str]:
    """Yield TOML; settings are numbers and texts, whose JSON is TOML too."""
    for name, value in settings.items():
        yield f"{name} = {json.dumps(value)}\n"
