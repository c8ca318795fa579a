"""Sealing: a file is under its final name only when it is whole, checked and on the disk."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sms_jobs.archive.layout import NO_JOB, temporary_name
from sms_jobs.archive.place import says_full, says_too_large, says_unusable
from sms_jobs.errors import Conflict, FileTooLarge, InvalidInput, SmsError, StorageFull, StorageUnusable

_READ_ONLY = 0o444


class SafeFile(io.RawIOBase):
    """A file for the HDF5 library that drops everything after the first error and remembers that error.

    The library must be able to close a file that it could not write, or it takes the process down with it
    when the disk is full.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = path.open("w+b", buffering=0)
        self.error: OSError | None = None

    def readinto(self, buffer: Any) -> int:
        """Read at the present place."""
        return self._file.readinto(buffer)

    def write(self, data: Any) -> int:
        """Write at the present place; after an error, pretend to."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self.error is None:
            try:
                done += self._file.write(view[done:])
            except OSError as error:
                self.error = error
        return len(view)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the present place."""
        return self._file.tell()

    def truncate(self, size: int | None = None) -> int:
        """Set the length; after an error, pretend to."""
        return self._file.truncate(size) if self.error is None else size or 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


@contextmanager
def safe_file(path: Path) -> Iterator[SafeFile]:
    """Give a new file to write HDF5 to; raise its first error, if any, when it is closed."""
    with SafeFile(path) as file:
        try:
            yield file
        finally:
            if file.error is not None:
                raise file.error


def sync(path: Path) -> None:
    """Force a file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256_of(file: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def copy_file(original: Path, copy: Path, check: Callable[[Path], object] | None = None) -> None:
    """Copy a file with its times and rights; under its name it is whole, on the disk, and passed `check`.

    What is there under that name is replaced.
    """
    copy.parent.mkdir(parents=True, exist_ok=True)
    growing = copy.with_name(f".{copy.name}.{os.getpid()}.tmp")
    try:
        shutil.copyfile(original, growing)
        shutil.copystat(original, growing)
        sync(growing)
        if check is not None:
            check(growing)
        growing.replace(copy)
        sync(copy.parent)
    finally:
        growing.unlink(missing_ok=True)


def make_folders(root: Path, folder: Path) -> None:
    """Create a folder below `root` and force the names on the way to the disk."""
    if folder != root and not folder.is_dir():
        make_folders(root, folder.parent)
        folder.mkdir(exist_ok=True)
        sync(folder.parent)


@contextmanager
def sealing(root: Path, path: Path, job_id: str) -> Iterator[Path]:
    """Give a temporary file in the folder of `path`; on success make it `path`, synced and read-only.

    Raises
    ------
    Conflict
        When there is a file at `path` already, or somebody else is writing it who has no job either.
    StorageFull
        When the disk is full; the temporary file is removed, as on every other error.
    StorageUnusable
        When the disk or share cannot be written to.
    """
    temporary = path.with_name(temporary_name(path.name, job_id))
    _refuse_taken(path)
    with blaming_the_place(path.name, str(root), str(path.parent)):
        make_folders(root, path.parent)
        if job_id == NO_JOB:
            _take_alone(temporary, path)
        try:
            yield temporary
            temporary.chmod(_READ_ONLY)
            sync(temporary)
            _refuse_taken(path)
            temporary.replace(path)
            sync(path.parent)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def _take_alone(temporary: Path, path: Path) -> None:
    """Create the temporary file of a name; a job is alone with its names, but nobody else is."""
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except FileExistsError:
        raise Conflict(f"{path} is being written by somebody else; choose another name") from None


def _refuse_taken(path: Path) -> None:
    if os.path.lexists(path):
        raise Conflict(f"{path} is sealed already and is never overwritten")


@contextmanager
def blaming_the_place(name: str, root: str, folder: str = "") -> Iterator[None]:
    """Turn errors that are the fault of a disk or share into `StorageFull` and `StorageUnusable`.

    Parameters
    ----------
    name, root, folder
        What was to be kept, in which archive, and in which part of it.
    """
    try:
        yield
    except SmsError:
        raise
    except BaseException as error:
        if says_full(error):
            raise StorageFull(
                f"the disk of {root} has no room for {name}; free some space and try again"
            ) from error
        if says_too_large(error):
            raise FileTooLarge(
                f"the disk of {root} takes no file as large as {name}; keep the archive in another file "
                "system, or raise what this account may write in one file ('ulimit -f')"
            ) from error
        if says_unusable(error):
            raise StorageUnusable(
                f"{name} cannot be kept in {folder or root} ({error}); look whether its disk or share is "
                "mounted, whole, and this account's to write to"
            ) from error
        raise


def copy_or_link(original: Path, target: Path, link: bool, advice: str) -> None:
    """Copy a file, or give it a second name; raise `InvalidInput`, with an advice, where it can have none."""
    if not link:
        shutil.copyfile(original, target)
        return
    try:
        target.hardlink_to(original)
    except OSError as error:
        if error.errno not in (errno.EXDEV, errno.EPERM, errno.ENOTSUP):
            raise
        raise InvalidInput(
            f"{target.parent} cannot have hard links to {original.parent}; {advice}"
        ) from error
