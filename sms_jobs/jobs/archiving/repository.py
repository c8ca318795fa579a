"""One way into the archive: a file is sealed and indexed, or nothing is left of it."""

from __future__ import annotations

import getpass
import logging
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy.orm import Session

import sms_jobs
from sms_jobs.archive import Archive, InputReference, Provenance, Sealed
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import CommitInDoubt, Conflict
from sms_jobs.jobs.archiving import indexing
from sms_jobs.jobs.archiving.indexing import Entry
from sms_jobs.records.subject import Subject

logger = logging.getLogger(__name__)

_TRIES = 20
"""So often another name is chosen because somebody else takes the one that was free."""


def operator() -> str:
    """Return who runs this process, as far as the system tells."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"


def brought_in(
    kind: str,
    subject: Subject,
    at: datetime,
    *,
    version: int = 1,
    parameters: Mapping[str, Any] | None = None,
    inputs: tuple[InputReference, ...] = (),
    statistics: Mapping[str, float] | None = None,
) -> Provenance:
    """Return the provenance of what no job makes: a person brings it in, here and now."""
    return Provenance(
        kind=kind,
        kind_version=version,
        subject=subject,
        job_id="",
        attempt=1,
        created_at=at,
        parameters=parameters or {},
        inputs=inputs,
        program_version=sms_jobs.__version__,
        host=socket.gethostname(),
        operator=operator(),
        statistics=statistics or {},
    )


@dataclass(frozen=True)
class Kept:
    """A file that was put into the archive.

    Attributes
    ----------
    file_id
        Of the catalogue.
    path
        Of what was sealed.
    new
        False where the catalogue had the same from another file, whose number it is; what was sealed is
        discarded.
    """

    file_id: int
    path: str
    new: bool


@dataclass(frozen=True)
class Repository:
    """The archive and the catalogue that knows what lies in it."""

    catalogue: Catalogue
    archive: Archive

    def put(
        self,
        records: Mapping[str, Any],
        provenance: Provenance,
        check: Callable[[Session], object] = lambda session: None,
        then: Callable[[Session], object] = lambda session: None,
        *,
        at: datetime | None = None,
    ) -> Kept:
        """Seal records in one file and index it, or leave nothing behind.

        Parameters
        ----------
        check, then
            Are called in the transaction that enters the file, before and after; what they raise keeps the
            file out.
        at
            When the file is entered; when it was made, if not given.

        Raises
        ------
        CommitInDoubt
            Nobody knows whether the catalogue has the file, which stays; 'sms archive repair' finds one
            that it has not.
        StorageFull, StorageUnusable
            It cannot be kept.
        """
        with self.batch() as batch:
            batch.seal(records, provenance)
            return batch.enter(check, then, at=at)[0]

    @contextmanager
    def batch(self) -> Iterator[Batch]:
        """Give what several files are put with, all of them or none; raises as `put` does."""
        batch = Batch(self)
        try:
            yield batch
        except CommitInDoubt:
            raise
        except BaseException:
            self.discard(batch.entries)
            raise

    def seal(self, records: Mapping[str, Any], provenance: Provenance) -> Entry:
        """Seal records in one file; return what is to be indexed of it, without its arrays.

        Of what no job makes, several may come in within a second: each has an attempt of its own.
        """
        sealed, provenance = self._sealed(records, provenance)
        try:
            return indexing.entry_of(sealed, provenance, lambda name, _: records.get(name))
        except BaseException:
            self.withdraw(sealed.path)
            raise

    def _sealed(self, records: Mapping[str, Any], provenance: Provenance) -> tuple[Sealed, Provenance]:
        """Seal records under a free name; where no job makes them, somebody may take it just now."""
        if provenance.job_id:
            return self.archive.seal_dataset(records, provenance), provenance
        tries = 0
        while True:
            provenance = self.archive.with_free_name(provenance)
            try:
                return self.archive.seal_dataset(records, provenance), provenance
            except Conflict:
                tries += 1
                if tries == _TRIES:
                    raise
            provenance = replace(provenance, attempt=provenance.attempt + 1)

    def seal_document(
        self, filename: str, media_type: str, write: Callable[[Path], None], provenance: Provenance
    ) -> Entry:
        """Seal a file that `write` fills; return what is to be indexed of it."""
        return Entry(self.archive.seal_document(filename, media_type, write, provenance), provenance)

    def withdraw(self, path: str) -> None:
        """Take a file out of the archive that the catalogue does not know, or has forgotten.

        A document goes with its provenance, and one that is not there is no fault. Raises `OSError` for a
        file that will not go.
        """
        self.archive.discard(path)

    def discard(self, entries: Iterable[Entry]) -> None:
        """Withdraw what was sealed and never entered; of a file that will not go the log tells."""
        for entry in entries:
            try:
                self.withdraw(entry.sealed.path)
            except OSError as error:
                logger.warning("%s stays: %s", entry.sealed.path, error)


@dataclass(frozen=True)
class Batch:
    """Files that come into the catalogue together.

    Attributes
    ----------
    entries
        Of the files that were sealed and not entered.
    """

    repository: Repository
    entries: list[Entry] = field(default_factory=list)

    def seal(self, records: Mapping[str, Any], provenance: Provenance) -> Entry:
        """Seal records in one file, as `Repository.seal` does."""
        self.entries.append(self.repository.seal(records, provenance))
        return self.entries[-1]

    def enter(
        self,
        check: Callable[[Session], object] = lambda session: None,
        then: Callable[[Session], object] = lambda session: None,
        *,
        at: datetime | None = None,
    ) -> list[Kept]:
        """Index all that was sealed in one transaction; discard what the catalogue has from other files.

        Parameters are those of `Repository.put`.
        """
        kept = []
        with self.repository.catalogue.writing() as session:
            check(session)
            for entry in self.entries:
                same = indexing.existing_file(session, entry)
                entered_at = at or entry.provenance.created_at
                number = indexing.index(session, entry, entered_at) if same is None else same
                kept.append(Kept(number, entry.sealed.path, same is None))
            then(session)
        same_again = [entry for entry, one in zip(self.entries, kept, strict=True) if not one.new]
        self.entries.clear()
        self.repository.discard(same_again)
        return kept
