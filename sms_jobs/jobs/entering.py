"""Sealed files that are entered into the catalogue, or taken out of the archive again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime

from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, Sealed
from sms_jobs.catalogue.models import FileRow
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


def enter_file(
    session: Session,
    sealed: Sealed,
    source: str,
    at: datetime,
    *,
    campaign_id: int | None = None,
    state_id: int | None = None,
    view: str | None = None,
    job_id: str | None = None,
) -> FileRow:
    """Enter what is on record of a sealed file, by which its readers know it again; return its row."""
    row = FileRow(
        source=source,
        path=sealed.path,
        content_hash=sealed.content_hash,
        size_bytes=sealed.size_bytes,
        sha256=sealed.sha256,
        media_type=sealed.media_type,
        created_at=at,
        campaign_id=campaign_id,
        state_id=state_id,
        view=view,
        job_id=job_id,
    )
    session.add(row)
    session.flush()
    return row
