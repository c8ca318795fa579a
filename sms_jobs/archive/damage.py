"""What is said of a file that cannot be read, or is not what was sealed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from sms_jobs.archive.provenance import digest
from sms_jobs.errors import ArchiveCorrupt

_BROKEN = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, MemoryError)
"""What h5py raises, or the code that follows it, when the bytes of a file make no sense."""


@contextmanager
def readable(where: str) -> Iterator[None]:
    """Turn what h5py raises on damaged files into `ArchiveCorrupt`."""
    try:
        yield
    except _BROKEN as error:
        reason = re.sub(r"\s+", " ", str(error))[:200]
        raise ArchiveCorrupt(f"{where} cannot be read ({reason}); restore it from a backup") from error


def altered(where: str, what: str, found: str, recorded: str) -> ArchiveCorrupt:
    """Say that something of a file is not what was sealed, and what to do about it."""
    return ArchiveCorrupt(
        f"{where} is not what was sealed: {what} {found}, but {recorded} is on record; 'sms archive repair' "
        "says whether a job makes it again, otherwise restore it from a backup"
    )


def differs(where: str, found: object, recorded: object) -> ArchiveCorrupt:
    """Say that what a file says of itself is not what was sealed."""
    first, second = (digest(str(one))[:12] for one in (found, recorded))
    return altered(where, "what it says of itself hashes to", f"{first}...", f"{second}...")
