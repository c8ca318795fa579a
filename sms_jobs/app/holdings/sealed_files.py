"""Sealed files as they lie in the archive, to be taken away."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

from sms_jobs.app.rules import use_case
from sms_jobs.archive import Archive
from sms_jobs.archive.sealed_bytes import read_bytes, require_size
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView


@dataclass(frozen=True)
class SealedFile:
    """A sealed file, and its bytes."""

    file: FileView
    _archive: Archive

    @property
    def name(self) -> str:
        """Its own name, without folders."""
        return self.file.path.rpartition("/")[2]

    @property
    def digest(self) -> str | None:
        """SHA-256 on record, as the field `Repr-Digest` of HTTP has it; None where it is not on record."""
        if not self.file.sha256:
            return None
        return f"sha-256=:{base64.b64encode(bytes.fromhex(self.file.sha256)).decode()}:"

    def read(self, start: int, stop: int) -> Iterator[bytes]:
        """Return the bytes from `start` up to `stop`, a MiB at a time.

        Raises `ArchiveCorrupt`, and for more than a MiB the iterator does, at its last bytes at the latest.
        """
        blocks = read_bytes(self._archive, self.file, start, stop)
        return chain([next(blocks, b"")], blocks)


@use_case(Right.READ)
def sealed_file(services: Services, key: str) -> SealedFile:
    """Return the sealed file of that number or archive path.

    Raises
    ------
    NotFound
        There is no such file.
    ArchiveCorrupt
        It is missing, or has another size than is on record.
    """
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    require_size(services.archive, view)
    return SealedFile(view, services.archive)
