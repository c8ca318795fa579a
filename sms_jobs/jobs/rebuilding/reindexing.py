"""Rebuilds the catalogue from the files of the archive alone, as far as files can tell.

Files are taken in the order in which they were made, each after its inputs, and judged before they are
entered: a file that is damaged, moved, or was left behind by a job that did not succeed, is refused with a
reason. What the catalogue knows already is passed over, so that a run that was interrupted goes on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Literal, TypeAlias

from sqlalchemy import select
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive, Checker, Found, Provenance, layout
from sms_jobs.catalogue import subject_files
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import CalibrationRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, OtherFormat, SmsError
from sms_jobs.jobs.archiving import indexing
from sms_jobs.jobs.archiving.indexing import ACCEPTANCE, CAMPAIGN
from sms_jobs.jobs.rebuilding import past_jobs
from sms_jobs.jobs.rebuilding.past_definitions import PastDefinitions
from sms_jobs.kinds.kind import CALIBRATION, REFERENCE_SURFACES
from sms_jobs.records.subject import Subject

Outcome: TypeAlias = Literal["indexed", "incomplete", "refused", "no-campaign", "too-new"]

_AT_ONCE = 500


@dataclass(frozen=True)
class Reindexed:
    """What became of one file.

    Attributes
    ----------
    outcome
        indexed. incomplete: indexed, but an input that it names is not there. refused: not to be trusted, or
        no output of its job. no-campaign: nothing says what its campaign is. too-new: a newer version wrote
        it.
    path, size_bytes
        Of the file.
    detail
        A sentence; empty when there is nothing to say.
    """

    outcome: Outcome
    path: str
    size_bytes: int
    detail: str = ""

    @property
    def entered(self) -> bool:
        """Whether it is in the catalogue, or would be."""
        return self.outcome in ("indexed", "incomplete")


@dataclass(frozen=True)
class Reindexing:
    """What became of the files that the catalogue did not know."""

    files: tuple[Reindexed, ...]

    @property
    def entered(self) -> int:
        """How many are in the catalogue, or would be."""
        return sum(one.entered for one in self.files)

    @property
    def not_well(self) -> tuple[Reindexed, ...]:
        """Those that were refused, or lack an input."""
        return tuple(one for one in self.files if one.outcome != "indexed")

    @property
    def size_bytes(self) -> int:
        """Of all of them."""
        return sum(one.size_bytes for one in self.files)


class _Refused(Exception):
    """Why a file is not entered."""


class _NoCampaign(Exception):
    """Nothing says what the campaign of a file is."""


@dataclass
class _Archived:
    """The archive as its names tell it, and what a dry run would have entered so far."""

    archive: Archive
    checker: Checker
    of_jobs: Mapping[tuple[str, str, str], Sequence[str]]
    definitions: PastDefinitions
    hashes: dict[str, str] = field(default_factory=dict)


def unknown_files(catalogue: Catalogue, archive: Archive) -> list[str]:
    """Return the sealed files that the catalogue does not know, definitions of campaigns first, by age."""
    sealed = sorted(archive.files(), key=_order)
    registered: set[str] = set()
    with catalogue.reading() as session:
        for start in range(0, len(sealed), _AT_ONCE):
            some = sealed[start : start + _AT_ONCE]
            registered.update(session.scalars(select(FileRow.path).where(FileRow.path.in_(some))))
    return [path for path in sealed if path not in registered]


def _order(path: str) -> tuple[bool, str, int, str]:
    first = layout.part(path, "kind") != CAMPAIGN
    return first, layout.part(path, "time"), int(layout.part(path, "attempt")), path


def _job(path: str) -> tuple[str, str, str]:
    return layout.campaign_of(path), layout.part(path, "kind"), layout.part(path, "job")


def reindex(
    catalogue: Catalogue,
    archive: Archive,
    paths: Sequence[str],
    *,
    dry_run: bool = False,
    checker: Checker | None = None,
) -> Iterator[Reindexed]:
    """Enter files into the catalogue and tell of each what became of it.

    All that was made within one second goes into one transaction, with the inputs that it has.

    Parameters
    ----------
    paths
        As `unknown_files` returns them.
    dry_run
        Say what would be done, and change nothing.
    checker
        That reads the files; one of its own if not given.
    """
    of_jobs: dict[tuple[str, str, str], list[str]] = {}
    definitions: dict[str, list[str]] = {}
    for path in sorted(archive.files(), key=_order):
        of_jobs.setdefault(_job(path), []).append(path)
        if layout.part(path, "kind") == CAMPAIGN:
            definitions.setdefault(layout.campaign_of(path), []).append(path)
    waiting = set(paths)
    with nullcontext(checker) if checker else Checker() as reader:
        archived = _Archived(archive, reader, of_jobs, PastDefinitions(archive, reader, definitions))
        for _, group in groupby(paths, key=lambda path: _order(path)[:2]):
            # A name tells the second in which a file was made, the file the rest.
            seen = {path: examined(archive, reader, path) for path in group if path in waiting}
            ordered = _inputs_first(archive, reader, seen, waiting)
            if dry_run:
                with catalogue.reading() as session:
                    done = [_entered(session, archived, one, dry_run=True) for one in ordered]
            else:
                with catalogue.writing() as session:
                    done = [_entered(session, archived, one, dry_run=False) for one in ordered]
            yield from done


def examined(archive: Archive, checker: Checker, path: str) -> Found | Reindexed:
    """Read a whole file; return what it says of itself, or why it is not entered."""
    try:
        return archive.examine(path, checker)
    except ArchiveCorrupt as error:
        return Reindexed("refused", path, _size(archive, path), str(error))
    except OtherFormat as error:
        return Reindexed("too-new", path, _size(archive, path), str(error))
    except InvalidInput as error:
        # A link that leads out of the archive.
        return Reindexed("refused", path, 0, str(error))


def _size(archive: Archive, path: str) -> int:
    return archive.size(path) or 0


def _inputs_first(
    archive: Archive, checker: Checker, seen: dict[str, Found | Reindexed], waiting: set[str]
) -> list[Found | Reindexed]:
    """Order files by age, each after those of its inputs that wait to be entered; clocks may differ."""
    ordered: list[Found | Reindexed] = []

    def visit(path: str) -> None:
        if path not in waiting:
            return
        waiting.remove(path)
        one = seen[path] if path in seen else examined(archive, checker, path)
        if isinstance(one, Found):
            for given in one.provenance.inputs:
                visit(given.path)
        ordered.append(one)

    ages = {path: one.provenance.created_at for path, one in seen.items() if isinstance(one, Found)}
    for path in sorted(seen, key=lambda p: (p not in ages, ages.get(p), p)):
        visit(path)
    return ordered


def _entered(session: Session, archived: _Archived, one: Found | Reindexed, *, dry_run: bool) -> Reindexed:
    if isinstance(one, Reindexed):
        return one
    path, size = one.sealed.path, one.sealed.size_bytes
    try:
        lacking = _judged(session, archived, one)
        if not dry_run:
            # Whole or not at all, and one that a database refuses spoils no other.
            with session.begin_nested():
                _enter(session, archived, one)
    except _NoCampaign as error:
        return Reindexed("no-campaign", path, size, str(error))
    except (_Refused, SmsError) as error:
        return Reindexed("refused", path, size, str(error))
    except DBAPIError as error:
        if error.connection_invalidated:
            raise
        return Reindexed("refused", path, size, f"the catalogue does not take it: {error.orig}")
    archived.hashes[path] = one.sealed.content_hash
    if lacking:
        return Reindexed("incomplete", path, size, f"its input {lacking[0]}")
    return Reindexed("indexed", path, size)


def _judged(session: Session, archived: _Archived, one: Found) -> list[str]:
    """Say what is wrong with the inputs of a file; raise `_Refused` when it is not to be entered."""
    path, provenance = one.sealed.path, one.provenance
    if not layout.fits(path, provenance):
        raise _Refused(f"it says that it is {layout.stem(provenance)} of {provenance.subject}: it was moved")
    if provenance.kind == CAMPAIGN:
        objection = archived.definitions.objection(session, one)
        if objection is not None:
            raise _Refused(objection)
    elif provenance.kind == CALIBRATION:
        _judge_calibration(session, one)
    elif provenance.kind != ACCEPTANCE:
        _judge_output(session, archived, one)
    lacking = []
    for given in provenance.inputs:
        found = archived.hashes.get(given.path) or session.scalar(
            select(FileRow.content_hash).where(FileRow.path == given.path)
        )
        if found != given.content_hash and indexing.input_of(session, given) is not None:
            continue
        if found is None:
            lacking.append(f"{given.path} is not there; restore it from a backup")
        elif found != given.content_hash:
            lacking.append(f"{given.path} is not the one that it was made from")
    return lacking


def _judge_calibration(session: Session, one: Found) -> None:
    file_id = indexing.calibration_file(session, one.sealed.content_hash)
    if file_id is not None:
        number = session.scalar(select(CalibrationRow.id).where(CalibrationRow.file_id == file_id))
        raise _Refused(f"the same calibration is number {number} of the catalogue")


def _judge_output(session: Session, archived: _Archived, one: Found) -> None:
    provenance, path = one.provenance, one.sealed.path
    subject = provenance.subject
    campaign = archived.definitions.at(session, provenance)
    if campaign is None:
        raise _NoCampaign(
            f"the definition of campaign {subject.campaign} is neither in the catalogue nor in the archive; "
            "create that campaign from its plan, then reindex again"
        )
    if subject.state is not None:
        campaign.state(subject.state)
    if provenance.kind != REFERENCE_SURFACES:
        # No job made a surface: attempts tell those apart that were brought in within one second.
        _judge_job(session, provenance)
        objection = past_jobs.objection(session, provenance, _newest_attempt(archived, path, provenance))
        if objection is not None:
            raise _Refused(objection)
    newer = _newer(session, one)
    if newer is not None:
        # The newest is the one with the highest number: an old one must not come after it.
        raise _Refused(f"the catalogue has a newer one about the same: file {newer}")


def _judge_job(session: Session, provenance: Provenance) -> None:
    """Refuse a file that names a job of the catalogue which was about something else."""
    job = session.get(JobRow, provenance.job_id)
    if job is None:
        return
    if job.kind != provenance.kind or not Subject.parse(job.subject).covers(provenance.subject):
        raise _Refused(f"its job {job.id[:8]} is known as {job.kind} of {job.subject}")


def _newest_attempt(archived: _Archived, path: str, provenance: Provenance) -> int:
    """Return the newest attempt of a job that has left files; names may be those of other jobs."""
    newest = provenance.attempt
    for other in archived.of_jobs.get(_job(path), ()):
        if int(layout.part(other, "attempt")) > newest:
            found = examined(archived.archive, archived.checker, other)
            if (
                isinstance(found, Found)
                and found.provenance.job_id == provenance.job_id
                and layout.fits(other, found.provenance)
            ):
                newest = found.provenance.attempt
    return newest


def _newer(session: Session, one: Found) -> int | None:
    if one.sealed.media_type != DATASET_MEDIA_TYPE:
        return None
    subject, source = one.provenance.subject, indexing.source_of(one.provenance)
    number = subject_files.newest_file(session, source, subject, DATASET_MEDIA_TYPE)
    newest = None if number is None else session.get_one(FileRow, number)
    if newest is None or newest.job_id == one.provenance.job_id:
        return None
    return newest.id if newest.created_at > one.provenance.created_at else None


def _enter(session: Session, archived: _Archived, one: Found) -> None:
    provenance = one.provenance
    campaign = None
    if provenance.kind not in (CAMPAIGN, CALIBRATION, ACCEPTANCE):
        campaign = archived.definitions.at(session, provenance)
        assert campaign is not None
        past_jobs.restore(session, campaign, provenance)

    def read(name: str, record: type[Any]) -> Any:
        with archived.archive.open(one.sealed) as dataset:
            return dataset.read(name, record) if name in dataset.names else None

    entry = indexing.entry_of(one.sealed, provenance, read)
    indexing.index(session, entry, provenance.created_at)
    if campaign is not None:
        past_jobs.make_reusable(session, campaign, provenance)
