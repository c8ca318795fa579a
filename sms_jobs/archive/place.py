"""The disk or share on which the archive lies: whether it can be used, and which errors are its fault."""

from __future__ import annotations

import errno
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from sms_jobs.errors import ArchiveCorrupt, SmsError, StorageFull, StorageUnusable

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_FORBIDDEN = frozenset({errno.EACCES, errno.EPERM})
_GONE = frozenset({errno.ESTALE, errno.ENOTCONN, errno.ENODEV, errno.ENXIO, errno.EHOSTDOWN, errno.ETIMEDOUT})
_UNUSABLE = _FORBIDDEN | _GONE | {errno.EROFS, errno.EIO}
_HDF5_ERRNO = re.compile(r"errno = (\d+)")
_CONTENT = b"can this be kept?"


def says_full(error: BaseException) -> bool:
    """Say whether an error means that the disk, or the quota, is full."""
    return not _FULL.isdisjoint(_numbers(error))


def says_too_large(error: BaseException) -> bool:
    """Say whether an error means that a disk takes no file so large, as FAT none of 4 GB."""
    return errno.EFBIG in _numbers(error)


def says_unusable(error: BaseException) -> bool:
    """Say whether an error means that the disk or share cannot be used, whatever file was asked for."""
    return not _UNUSABLE.isdisjoint(_numbers(error))


def fault_of_the_place(error: Exception) -> Exception:
    """Return what a full or unusable disk has caused as an error of the storage; any other error as it is."""
    if isinstance(error, SmsError) and not isinstance(error, ArchiveCorrupt):
        return error
    if isinstance(error, OSError) and says_full(error):
        return StorageFull(f"the disk is full: {error.filename or 'writing an output'}; free some space")
    if says_unusable(error):
        return StorageUnusable(f"the archive could not be used ({error}); look at its disk or share")
    return error


def _numbers(error: BaseException | None) -> Iterator[int]:
    """Yield the system's error numbers of an error and of what led to it; HDF5 tells them in words alone."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, OSError) and error.errno is not None:
            yield error.errno
        if isinstance(error, OSError | RuntimeError):
            yield from (int(number) for number in _HDF5_ERRNO.findall(str(error)))
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def unusable(folder: Path, error: OSError | None = None) -> StorageUnusable:
    """Return what says that a folder cannot be used, and what a person can do about it."""
    number = errno.EROFS if error is None else error.errno
    if number == errno.EROFS:
        hint = "look why with 'dmesg', and mount it for writing again"
    elif number in _FORBIDDEN:
        hint = "give the service's account permission to write there"
    elif number == errno.EIO:
        hint = "look at the disk and at 'dmesg'"
    else:
        hint = "look whether its disk or share is mounted"
    reason = os.strerror(number) if number else str(error)
    return StorageUnusable(f"the archive cannot be used at {folder} ({reason}); {hint}")


def require_usable(folder: Path, least_mb: float) -> None:
    """Ask what can be asked before every job.

    Raises
    ------
    StorageFull
        There is less room than a job needs to be started.
    StorageUnusable
        It is mounted read-only, or does not answer.
    """
    try:
        found = os.statvfs(folder)
    except OSError as error:
        raise unusable(folder, error) from error
    if found.f_flag & os.ST_RDONLY:
        raise unusable(folder)
    free_mb = found.f_bavail * found.f_frsize / 1e6
    if free_mb < least_mb:
        raise StorageFull(
            f"the archive's disk has {free_mb:.0f} MB left and no job begins with less than {least_mb:g} MB "
            "(setting least_room_mb); free some space"
        )


def probe(folder: Path) -> None:
    """Do once what sealing does: write a file, force it to the disk, rename it, and read it; leave nothing.

    Raises
    ------
    StorageFull
        There is not even room for that.
    StorageUnusable
        It cannot be done, or what was written is not kept.
    """
    # A folder that begins with a dot is no part of the archive, should it have to stay.
    inside = folder / f".probe-{secrets.token_hex(4)}"
    growing, sealed = inside / "growing", inside / "sealed"
    try:
        inside.mkdir()
        with growing.open("xb") as stream:
            stream.write(_CONTENT)
            stream.flush()
            os.fsync(stream.fileno())
        growing.replace(sealed)
        kept = sealed.read_bytes() == _CONTENT
    except OSError as error:
        if says_full(error):
            raise StorageFull(f"the disk of {folder} is full; free some space") from error
        raise unusable(folder, error) from error
    finally:
        for left in (growing, sealed):
            with suppress(OSError):
                left.unlink(missing_ok=True)
        with suppress(OSError):
            inside.rmdir()
    if not kept:
        raise StorageUnusable(f"{folder} does not keep what is written; use another file system")
