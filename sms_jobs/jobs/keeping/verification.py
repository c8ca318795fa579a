"""Compares the archive on the disk with the catalogue: what is missing, damaged, unknown or left behind."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Literal, TypeAlias

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, Checker, layout
from sms_jobs.catalogue import audit
from sms_jobs.catalogue.campaigns import campaign_id
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, OtherFormat
from sms_jobs.records.job import ACTIVE

Problem: TypeAlias = Literal["missing", "corrupt", "too-new", "unknown", "unfinished", "stray", "audit"]

_AT_ONCE = 500


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be.

    Attributes
    ----------
    problem
        missing: the catalogue knows it and the disk does not. corrupt: its contents are not those that were
        sealed, or of a document, its provenance is not. too-new: a newer version wrote it. unknown: it is
        sealed, and the catalogue does not know it. unfinished: a job that has ended was writing it. stray: it
        is no part of the archive, or the provenance of a document that is not there. audit: the chain that
        says who did what, or an event of a job that it holds, is not as it was written.
    path
        In the archive; that of the catalogue where the problem is its audit.
    detail
        A sentence.
    """

    problem: Problem
    path: str
    detail: str


@dataclass(frozen=True)
class Checked:
    """How far a verification has come: one file after the other, in the order of their numbers."""

    file_id: int
    path: str
    size_bytes: int
    finding: Finding | None


@dataclass(frozen=True)
class Extent:
    """How much there is to check."""

    files: int
    size_bytes: int


def extent(session: Session, after: int = 0, campaign: str | None = None) -> Extent:
    """Return how many files `check_known` will read, and their size; `NotFound` for an unknown campaign."""
    query = select(func.count(), func.coalesce(func.sum(FileRow.size_bytes), 0)).where(FileRow.id > after)
    if campaign is not None:
        query = query.where(FileRow.campaign_id == campaign_id(session, campaign))
    files, size = session.execute(query).one()
    return Extent(files, int(size))


def check_known(
    catalogue: Catalogue,
    archive: Archive,
    *,
    after: int = 0,
    campaign: str | None = None,
    quick: bool = False,
    checker: Checker | None = None,
) -> Iterator[Checked]:
    """Check every file that the catalogue knows, in the order of their numbers.

    Parameters
    ----------
    after
        Number of the last file that is known to be well: a verification goes on where another ended.
    campaign
        Only its files.
    quick
        Look at presence and size alone.
    checker
        That reads the files; one of its own if not given.
    """
    with nullcontext(checker) if checker else Checker() as reader:
        while True:
            query = select(FileRow).where(FileRow.id > after).order_by(FileRow.id).limit(_AT_ONCE)
            if campaign is not None:
                query = query.join(CampaignRow, CampaignRow.id == FileRow.campaign_id).where(
                    CampaignRow.name == campaign
                )
            # The session is not kept open while files are read, which may take hours.
            with catalogue.reading() as session:
                rows = [(f.id, f.path, f.content_hash, f.size_bytes) for f in session.scalars(query)]
            if not rows:
                return
            for file_id, path, content_hash, size in rows:
                finding = _of_file(archive, path, content_hash, size, None if quick else reader)
                yield Checked(file_id, path, size, finding)
            after = rows[-1][0]


def check_audit(catalogue: Catalogue) -> Iterator[Finding]:
    """Find where the chain that says who did what is not as it was written."""
    with catalogue.reading() as session:
        for sentence in audit.breaks(session):
            yield Finding("audit", "(catalogue)", sentence)


def _of_file(
    archive: Archive, path: str, content_hash: str, size_bytes: int, checker: Checker | None
) -> Finding | None:
    try:
        found = archive.size(path)
    except InvalidInput as error:
        return Finding("corrupt", path, str(error))
    if found is None:
        return Finding("missing", path, "it is in the catalogue and not on the disk")
    if found != size_bytes:
        return Finding("corrupt", path, f"it has {found} bytes, but {size_bytes} were sealed")
    if checker is None:
        return None
    try:
        archive.verify(path, content_hash, checker)
        if not layout.is_dataset(path):
            archive.verify_provenance(path, content_hash)
    except ArchiveCorrupt as error:
        return Finding("corrupt", path, str(error))
    except OtherFormat as error:
        return Finding("too-new", path, str(error))
    return None


def check_unknown(catalogue: Catalogue, archive: Archive) -> Iterator[Finding]:
    """Find the files on the disk that the catalogue does not know, and those that are none of the archive."""
    with catalogue.reading() as session:
        # One that has never started has left nothing.
        begun = select(JobRow.id).where(JobRow.state.in_(ACTIVE), JobRow.attempts > 0)
        active = set(session.scalars(begun))
    # Listed before they are looked up: what is sealed in between is known by then, or its job is active.
    unfinished, sealed, strays = list(archive.unfinished()), list(archive.files()), dict(archive.strays())
    for path, job_id in sorted(unfinished):
        if job_id not in active:
            yield Finding("unfinished", path, f"job {job_id} has ended and left it behind")
    # The provenance of a document that is missing is kept for when it is restored.
    for path in _not_known(catalogue, archive, active, (layout.without_sidecar(path) for path in strays)):
        for left in (path, layout.sidecar(path)):
            if left in strays:
                yield Finding("stray", left, strays[left])
    for path in _not_known(catalogue, archive, active, sealed):
        yield Finding("unknown", path, "it is sealed, but not in the catalogue")


def _not_known(
    catalogue: Catalogue, archive: Archive, active: set[str], paths: Iterable[str]
) -> Iterator[str]:
    """Yield, in order, what neither the catalogue knows nor a job that may still register it has sealed."""
    every = sorted(set(paths))
    with catalogue.reading() as session:
        for start in range(0, len(every), _AT_ONCE):
            some = every[start : start + _AT_ONCE]
            registered = set(session.scalars(select(FileRow.path).where(FileRow.path.in_(some))))
            for path in some:
                if path not in registered and not any(archive.is_of_job(path, job) for job in active):
                    yield path
