"""A sealed file as it lies there, for whoever takes it away."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

from sms_jobs.archive.archive import Archive
from sms_jobs.archive.damage import altered
from sms_jobs.archive.provenance import Recorded
from sms_jobs.errors import ArchiveCorrupt

_BLOCK_BYTES = 1 << 20


def require_size(archive: Archive, file: Recorded) -> None:
    """Raise `ArchiveCorrupt` unless a file is there and has the size on record."""
    size = archive.size(file.path)
    if size is None:
        raise ArchiveCorrupt(f"{file.path} is missing from the archive; restore it from a backup")
    if size != file.size_bytes:
        raise altered(file.path, "it has", f"{size} bytes", str(file.size_bytes))


def read_bytes(archive: Archive, file: Recorded, start: int, stop: int) -> Iterator[bytes]:
    """Yield the bytes of a sealed file from `start` up to `stop`, a MiB at a time.

    What is taken as a whole is compared before its last bytes are given out; a part is not.

    Raises `ArchiveCorrupt` where the file has other bytes, or fewer, than are on record.
    """
    compared = (start, stop) == (0, file.size_bytes) and file.sha256
    hashed = hashlib.sha256()
    with archive.store.open(file.path) as stream:
        stream.seek(start)
        while start < stop:
            block = stream.read(min(_BLOCK_BYTES, stop - start))
            if not block:
                raise ArchiveCorrupt(f"{file.path} ended while it was read; restore it from a backup")
            start += len(block)
            hashed.update(block)
            found = hashed.hexdigest() if start == stop else ""
            if compared and found and found != compared:
                raise altered(file.path, "its bytes hash to", f"{found[:12]}...", f"{compared[:12]}...")
            yield block
