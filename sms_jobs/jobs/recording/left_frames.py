"""Frames that recordings have left in this host's spool and that nobody will ask for any more."""

from __future__ import annotations

import shutil
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.records.job import JobState

_GONE = ".gone"


@dataclass(frozen=True)
class LeftFrames:
    """The spool of a recording that has ended.

    Attributes
    ----------
    job_id, subject, state
        Of the recording: one that was given up, or one whose measurements lie in the archive and whose
        process ended before it could tidy up.
    path, size_bytes
        Of its folder.
    ended_at
        When the job ended.
    """

    job_id: str
    subject: str
    state: JobState
    path: Path
    size_bytes: int
    ended_at: datetime


def removable(
    session: Session, spool: Path, now: datetime, older_than: timedelta, kinds: Collection[str] = ()
) -> list[LeftFrames]:
    """Return what a policy removes: frames of recordings that succeeded or were cancelled so long ago.

    Those of one that has failed or waits for an operator are needed when it goes on, and of a job that the
    catalogue does not know nobody can tell.

    Parameters
    ----------
    kinds
        Only of jobs of these; of all when empty.
    """
    folders = {path.name: path for path in sorted(spool.glob("[0-9a-f]*")) if path.is_dir()}
    ended = select(JobRow).where(
        JobRow.state.in_((JobState.SUCCEEDED, JobState.CANCELLED)),
        JobRow.finished_at < now - older_than,
    )
    if kinds:
        ended = ended.where(JobRow.kind.in_(kinds))
    # Locked, so that nobody lets one go on while its frames are taken away.
    locked = ended.order_by(JobRow.id).with_for_update(skip_locked=True)
    return [
        LeftFrames(job.id, job.subject, job.state, folders[job.id], _size(folders[job.id]), job.finished_at)
        for names in parts(sorted(folders))
        for job in session.scalars(locked.where(JobRow.id.in_(names)))
        if job.finished_at is not None
    ]


def remove(
    catalogue: Catalogue, spool: Path, now: datetime, older_than: timedelta, kinds: Collection[str] = ()
) -> list[LeftFrames]:
    """Remove what a policy does not keep, and return it."""
    with catalogue.writing() as session:
        gone = removable(session, spool, now, older_than, kinds)
        for one in gone:
            one.path.replace(one.path.with_name(f"{_GONE}-{one.job_id}"))
    # Also what is left of a removal that was killed; somebody else may be at it too.
    for path in spool.glob(f"{_GONE}-*"):
        shutil.rmtree(path, ignore_errors=True)
    return gone


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
