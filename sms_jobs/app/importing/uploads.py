"""Uploads: files that come over the network in chunks, until they are imported.

Each lies in a folder of its own in this host's spool, belongs to the person who began it, and is gone a day
later. Chunks are checked before they are added, so that an upload that broke off goes on where it was.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sms_jobs.app.rules import use_case
from sms_jobs.archive.place import says_full
from sms_jobs.bootstrap import Services
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError, StorageFull
from sms_jobs.records.people import Right
from sms_jobs.records.sizes import size
from sms_jobs.records.texts import checked_text

CHUNK_BYTES = 8 << 20
"""The most that a chunk may hold."""
MOST_BYTES = 64 << 30
MOST_FILES = 100_000
MOST_AT_A_TIME = 10
"""Uploads of a person."""
KEPT_FOR = timedelta(days=1)

_FOLDER = "uploads"
_FILES = "files"
_ABOUT = "about.json"
_NAME_LETTERS = 500
_PART_BYTES = 200
_DEEPEST = 8
_LEFT_FREE_BYTES = 1 << 30
"""Of the spool's disk, for recordings."""


@dataclass(frozen=True)
class UploadedFile:
    """A file of an upload, and how much of it is there."""

    name: str
    size_bytes: int


@dataclass(frozen=True)
class Upload:
    """An upload, and what of it is there."""

    id: str
    started_at: datetime
    ends_at: datetime
    size_bytes: int
    files: tuple[UploadedFile, ...]


@dataclass(frozen=True)
class Chunk:
    """A part of a file.

    Attributes
    ----------
    offset
        Of its first byte in the file.
    content
        Its bytes.
    sha256
        Of them, in hexadecimal, as whoever sent them says.
    """

    offset: int
    content: memoryview
    sha256: str


@dataclass(frozen=True)
class _About:
    person: str
    started_at: datetime
    size_bytes: int
    files: int


@use_case(Right.COMPUTE)
def begin(services: Services) -> Upload:
    """Begin an upload, and forget those that have ended; raise `Conflict` where a person has too many."""
    folder = services.settings.spool_folder / _FOLDER
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    now, own = datetime.now(UTC), 0
    for one in _there(folder):
        about = _about(one)
        if about is None or about.started_at + KEPT_FOR < now:
            _forget(one)
        elif about.person == services.actor.name:
            own += 1
    if own >= MOST_AT_A_TIME:
        raise Conflict(
            f"{services.actor.name} has {own} uploads, and may have {MOST_AT_A_TIME} at a time; remove one"
        )
    made = folder / f"u{secrets.token_hex(12)}"
    (made / _FILES).mkdir(mode=0o700, parents=True)
    _write_about(made, _About(services.actor.name, now, 0, 0))
    return _shown(made, _About(services.actor.name, now, 0, 0))


@use_case(Right.COMPUTE)
def write(services: Services, upload: str, name: str, chunk: Chunk) -> UploadedFile:
    """Add a chunk to a file of an upload; return how much of the file is there.

    The same chunk once more changes nothing: whoever did not hear that it came sends it again.

    Parameters
    ----------
    upload
        Its id.
    name
        Of the file: a path below the upload's folder, with forward slashes.

    Raises
    ------
    NotFound
        The actor has no such upload.
    InvalidInput
        The name leads elsewhere or cannot be one, the bytes are not those of the hash, or too many.
    Conflict
        The chunk does not begin where the file ends.
    StorageFull
        The spool's disk has no room for it.
    """
    if len(chunk.content) > CHUNK_BYTES:
        raise InvalidInput(
            f"a chunk has {size(CHUNK_BYTES)} at most, not {size(len(chunk.content))}; send less at a time"
        )
    path = checked_path(name)
    if hashlib.sha256(chunk.content).hexdigest() != chunk.sha256.lower():
        raise InvalidInput(f"the bytes of '{path}' that came are not those of the hash; send them again")
    folder = _own(services, upload)
    with _held(folder, fcntl.LOCK_EX):
        about = _known(folder, upload)
        file = folder / _FILES / path
        there = _length(file)
        if about.size_bytes + len(chunk.content) > MOST_BYTES or about.files + (there is None) > MOST_FILES:
            raise InvalidInput(
                f"an upload has {size(MOST_BYTES)} and {MOST_FILES} files at most; import what is there, and "
                "begin another"
            )
        if shutil.disk_usage(folder).free - len(chunk.content) < _LEFT_FREE_BYTES:
            raise StorageFull(
                f"less than {size(_LEFT_FREE_BYTES)} would be left on the spool's disk, which recordings "
                "need; free some"
            )
        grown = _add(file, there or 0, chunk)
        new = _About(about.person, about.started_at, about.size_bytes + grown, about.files + (there is None))
        _write_about(folder, new)
        return UploadedFile(path, (there or 0) + grown)


@use_case(Right.COMPUTE)
def show(services: Services, upload: str) -> Upload:
    """Return what of an upload is there; raises `NotFound` where the actor has no such upload."""
    folder = _own(services, upload)
    return _shown(folder, _known(folder, upload))


@use_case(Right.COMPUTE)
def list_uploads(services: Services) -> list[Upload]:
    """Return the uploads of the actor, without their files."""
    found = [(one, _about(one)) for one in _there(services.settings.spool_folder / _FOLDER)]
    return [
        Upload(one.name, about.started_at, about.started_at + KEPT_FOR, about.size_bytes, ())
        for one, about in found
        if about is not None and about.person == services.actor.name
    ]


@use_case(Right.COMPUTE)
def remove(services: Services, upload: str) -> None:
    """Remove an upload; raises `NotFound` as `show` does, `Conflict` while it is written or imported."""
    folder = _own(services, upload)
    if not _forget(folder):
        raise Conflict(f"upload {upload} is being written or imported; try again when that has ended")


@use_case(Right.COMPUTE)
def opened(services: Services, upload: str) -> AbstractContextManager[Path]:
    """Return the folder of an upload's files, which stays as long as it is open; raises as `show` does."""
    return _opened(_own(services, upload))


@contextmanager
def _opened(folder: Path) -> Iterator[Path]:
    files = folder / _FILES
    with _held(folder, fcntl.LOCK_SH):
        try:
            yield files
        except SmsError as error:
            # Where the spool lies is of no use to whoever sent the files.
            words = str(error).replace(f"{files}/", "").replace(str(files), "the upload")
            raise type(error)(words) from error


def checked_path(name: str) -> str:
    """Return the path of a file below an upload's folder.

    Raises `InvalidInput` for one that is absolute, climbs, is hidden, too long or too deep.
    """
    checked_text(name, "the name of a file", _NAME_LETTERS)
    parts = name.split("/")
    wrong = [p for p in parts if not p or p.startswith(".") or len(p.encode()) > _PART_BYTES or "\\" in p]
    if wrong or len(parts) > _DEEPEST or any(ord(letter) < 32 for letter in name):
        raise InvalidInput(
            f"'{name:.80}' cannot be the name of a file of an upload: use at most {_DEEPEST} parts with '/' "
            "between, none of which is empty, begins with '.' or has a backslash"
        )
    return name


def _there(folder: Path) -> list[Path]:
    return sorted(one for one in folder.glob("u*") if one.is_dir())


def _own(services: Services, upload: str) -> Path:
    """Return the folder of an upload of the actor; raise `NotFound` where there is none."""
    folder = services.settings.spool_folder / _FOLDER / upload
    about = _about(folder) if upload.isascii() and upload.isalnum() else None
    if (
        about is None
        or about.person != services.actor.name
        or about.started_at + KEPT_FOR < datetime.now(UTC)
    ):
        raise NotFound(f"{services.actor.name} has no upload '{upload:.80}', or it has ended; begin another")
    return folder


def _known(folder: Path, upload: str) -> _About:
    about = _about(folder)
    if about is None:
        raise NotFound(f"upload '{upload:.80}' was removed; begin another")
    return about


def _about(folder: Path) -> _About | None:
    try:
        table = json.loads((folder / _ABOUT).read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return _About(
        table["person"], datetime.fromisoformat(table["started_at"]), table["bytes"], table["files"]
    )


def _write_about(folder: Path, about: _About) -> None:
    part = folder / f"{_ABOUT}.part"
    table = {
        "person": about.person,
        "started_at": about.started_at.isoformat(),
        "bytes": about.size_bytes,
        "files": about.files,
    }
    part.write_text(json.dumps(table), "utf-8")
    part.replace(folder / _ABOUT)


def _shown(folder: Path, about: _About) -> Upload:
    files = folder / _FILES
    found = sorted(path for path in files.rglob("*") if path.is_file())
    return Upload(
        folder.name,
        about.started_at,
        about.started_at + KEPT_FOR,
        about.size_bytes,
        tuple(UploadedFile(path.relative_to(files).as_posix(), path.stat().st_size) for path in found),
    )


def _length(file: Path) -> int | None:
    """Return how much of a file is there; None where nothing is."""
    try:
        if file.is_dir():
            raise InvalidInput(f"'{file.name}' is a folder of this upload; give the file another name")
        return file.stat().st_size
    except FileNotFoundError:
        return None
    except NotADirectoryError as error:
        raise InvalidInput(
            f"a folder in the path of '{file.name}' is a file of this upload; give another name"
        ) from error


def _add(file: Path, there: int, chunk: Chunk) -> int:
    """Add a chunk to a file of some length, and return by how much it has grown."""
    if chunk.offset + len(chunk.content) <= there:
        with file.open("rb") as before:
            before.seek(chunk.offset)
            if before.read(len(chunk.content)) == chunk.content:
                return 0
    if chunk.offset != there:
        raise Conflict(
            f"{there} bytes of '{file.name}' are there: go on at offset {there}, not {chunk.offset}"
        )
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with file.open("ab") as grown:
            try:
                grown.write(chunk.content)
                grown.flush()
            except OSError:
                os.ftruncate(grown.fileno(), there)
                raise
    except OSError as error:
        if says_full(error):
            raise StorageFull("the spool's disk has no room for this chunk; free some") from error
        raise
    return len(chunk.content)


@contextmanager
def _held(folder: Path, how: int) -> Iterator[None]:
    """Hold an upload: alone, or with others who only read; waits for others but with `LOCK_NB`."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except FileNotFoundError as error:
        raise NotFound(f"upload '{folder.name}' was removed; begin another") from error
    try:
        fcntl.flock(descriptor, how)
        yield
    finally:
        os.close(descriptor)


def _forget(folder: Path) -> bool:
    """Remove an upload unless somebody uses it; return whether it is gone."""
    with suppress(NotFound):
        try:
            with _held(folder, fcntl.LOCK_EX | fcntl.LOCK_NB):
                (folder / _ABOUT).unlink(missing_ok=True)
                shutil.rmtree(folder, ignore_errors=True)
        except BlockingIOError:
            return False
    return True
