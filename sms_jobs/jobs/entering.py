"""Sealed files that are entered into the catalogue, or taken out of the archive again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sms_jobs.archive import Archive, Sealed
from sms_jobs.errors import CommitInDoubt


@contextmanager
def entered_or_discarded(archive: Archive) -> Iterator[list[Sealed]]:
    """Give a list for what is sealed; whatever fails inside, the files in it are taken away again.

    Where nobody knows whether the catalogue has them they stay: 'sms archive repair' finds those that it has
    not.
    """
    sealed: list[Sealed] = []
    try:
        yield sealed
    except CommitInDoubt:
        raise
    except BaseException:
        for one in sealed:
            archive.discard(one.path)
        raise
