"""The archive: sealed files that never change, in a store.

HDF5 is loaded where a dataset is written or opened: to ask for room, names or bytes takes none of it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sms_jobs.archive import layout
from sms_jobs.archive.checking import Checker
from sms_jobs.archive.damage import altered
from sms_jobs.archive.form import (
    DATASET_MEDIA_TYPE,
    FORMAT,
    FORMAT_VERSION,
    LARGEST_TEXT_BYTES,
    require_version,
)
from sms_jobs.archive.provenance import (
    Found,
    Provenance,
    Recorded,
    Sealed,
    digest_of,
    provenance_from_json,
    provenance_to_json,
)
from sms_jobs.archive.sealing import copy_or_link, sha256_of
from sms_jobs.archive.store import LocalFile, Room, Store
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, OtherFormat
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.archive.dataset import ArchivedDataset

_COMPARED_FIRST_BYTES = 256 << 10
"""A file of at most so much is compared as a whole before HDF5 sees it, which some damage makes spin.

Most of a small file is what HDF5 finds its way by; of a large one that is next to nothing, and arrays, which
are compared when they are read.
"""
_OF_A_NETWORK_DISK = ".nfs"
"""Begins the names of files that are removed while somebody still reads them; they go by themselves."""
_ADOPTED = "import"
"""Stands for the job of a file that comes as a whole from another archive."""


class Archive:
    """Sealed files in a store.

    A sealed file is complete, checked and on the disk before it has its name, and is never changed or
    overwritten afterwards. Paths are names in the store, with forward slashes.
    """

    def __init__(self, store: Store) -> None:
        self.store = store

    @property
    def where(self) -> str:
        """The archive, as messages name it."""
        return self.store.where

    def location(self, path: str) -> str:
        """Return where a person finds a file."""
        return self.store.location(path)

    def size(self, path: str) -> int | None:
        """Return the size of a file in bytes; None where there is none."""
        return self.store.size(path)

    def has(self, path: str) -> bool:
        """Say whether there is a file that can be read."""
        return self.store.size(path) is not None

    def local(self, path: str) -> AbstractContextManager[LocalFile]:
        """Give a path at which a file can be read meanwhile."""
        return self.store.local(path)

    def room(self) -> Room:
        """Return how much room there is."""
        return self.store.room()

    def require_usable(self, least_mb: float) -> None:
        """Ask what can be asked before every job.

        Raises
        ------
        StorageFull
            There is less room than so many MB.
        StorageUnusable
            The store can only be read, or does not answer.
        """
        self.store.require_usable(least_mb)

    def probe(self, subject: Subject | None = None) -> None:
        """Find out whether files can be kept, and where those of a subject lie.

        Raises
        ------
        StorageFull, StorageUnusable
            They cannot.
        """
        self.store.probe("" if subject is None else layout.folder(subject))

    def seal_dataset(self, records: Mapping[str, Any], provenance: Provenance) -> Sealed:
        """Store records in one HDF5 file; the first is shown when the file is opened in a viewer.

        Raises
        ------
        Conflict
            When the job's attempt has sealed a file of that name already.
        StorageFull
            When the disk is full; nothing is left behind, as on every other error.
        """
        from sms_jobs.archive.dataset import write_dataset

        path = layout.dataset_path(provenance)
        with self.store.create(path, layout.identity(provenance)) as file:
            return write_dataset(file, path, records, provenance)

    def seal_document(
        self, filename: str, media_type: str, write: Callable[[LocalFile], None], provenance: Provenance
    ) -> Sealed:
        """Store a file that `write` fills at the path that it is given, and its provenance beside it.

        The file is called `<kind>-<time>-<job>-<attempt>-<filename>`. Raises as `seal_dataset` does.
        """
        path = layout.document_path(provenance, filename)
        job = layout.identity(provenance)
        with self.store.create(path, job) as file:
            write(file)
            if not file.is_file():
                raise InvalidInput(f"nothing was written for {filename} of {provenance.subject}")
            sha256, size = sha256_of(file), file.stat().st_size
            sealed = Sealed(path, sha256, size, media_type, sha256)
            about = {
                "format": f"{FORMAT}-document",
                "format_version": FORMAT_VERSION,
                "filename": filename,
                "media_type": media_type,
                "content_hash": sealed.content_hash,
                "provenance": json.loads(provenance_to_json(provenance)),
            }
            about["sha256"] = digest_of(about)
            # First, so that no document is ever without its provenance.
            with self.store.create(layout.sidecar(path), job) as beside:
                beside.write_text(json.dumps(about, indent=1), encoding="utf-8")
        return sealed

    def with_free_name(self, provenance: Provenance) -> Provenance:
        """Return a provenance with the first attempt from its own on whose dataset is not there."""
        while self.store.exists(layout.dataset_path(provenance)):
            provenance = replace(provenance, attempt=provenance.attempt + 1)
        return provenance

    def open(self, file: Recorded) -> AbstractContextManager[ArchivedDataset]:
        """Open a dataset file that the catalogue knows, for reading.

        Raises
        ------
        ArchiveCorrupt
            When it is missing, or another one than is on record: at once where its size, its texts or the
            digests of its arrays differ, and when an array is read that differs from its digest.
        OtherFormat
            When it was written by a newer version.
        """
        if file.sha256 and file.size_bytes <= _COMPARED_FIRST_BYTES:
            self.verify_bytes(file)
        return self._opened(file.path, file.content_hash, file.size_bytes)

    def open_unrecorded(self, path: str) -> AbstractContextManager[ArchivedDataset]:
        """Open a dataset file of which nothing is on record; it must be what it says of itself.

        Raises as `open` does.
        """
        return self._opened(path)

    @contextmanager
    def _opened(
        self, path: str, content_hash: str = "", size_bytes: int | None = None
    ) -> Iterator[ArchivedDataset]:
        from sms_jobs.archive.dataset import open_dataset

        with (
            self.store.local(path) as file,
            open_dataset(file, path, content_hash, size_bytes) as dataset,
        ):
            yield dataset

    def document_provenance(self, path: str) -> Provenance:
        """Return how a document came about; raise `ArchiveCorrupt` when that is not known."""
        return self._beside(path)[0]

    def _beside(self, path: str) -> tuple[Provenance, str, str]:
        """Return provenance, content hash and media type of a document, as they stand beside it."""
        name = layout.sidecar(path)
        beside, size = self.store.location(name), self.store.size(name)
        if size is None or size > LARGEST_TEXT_BYTES:
            raise ArchiveCorrupt(f"the provenance of {path} is missing; restore {beside}")
        try:
            with self.store.open(name) as stream:
                about = json.loads(stream.read())
            version = int(about["format_version"])
            provenance, content_hash = about["provenance"], str(about["content_hash"])
            media_type = str(about["media_type"])
            # Files of older programs have none.
            whole = about.pop("sha256", None) in (None, digest_of(about))
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise ArchiveCorrupt(f"the provenance of {path} cannot be read; restore {beside}") from error
        if not whole:
            raise ArchiveCorrupt(f"the provenance of {path} was altered; restore {beside}")
        require_version(path, version)
        return provenance_from_json(json.dumps(provenance), path), content_hash, media_type

    def verify_provenance(self, path: str, content_hash: str) -> None:
        """Raise `ArchiveCorrupt` unless the provenance beside a document is whole and of those contents."""
        recorded = self._beside(path)[1]
        if recorded != content_hash:
            raise ArchiveCorrupt(
                f"the provenance of {path} is of contents with the hash {recorded[:12]}..., but "
                f"{content_hash[:12]}... is on record; restore it from a backup"
            )

    def examine(self, path: str, checker: Checker) -> Found:
        """Read a whole file and return what it says of itself, which is all that is known of it.

        Raises
        ------
        ArchiveCorrupt
            When its contents are not those that it says were sealed.
        OtherFormat
            When it was written by a newer version.
        """
        if layout.is_dataset(path):
            self.verify(path, "", checker)
            with self.open_unrecorded(path) as dataset:
                provenance, content_hash = dataset.provenance, dataset.content_hash
            media_type = DATASET_MEDIA_TYPE
        else:
            provenance, content_hash, media_type = self._beside(path)
            self.verify(path, content_hash)
        size, sha256 = self.store.size(path), self._sha256(path)
        assert size is not None
        return Found(Sealed(path, content_hash, size, media_type, sha256), provenance)

    def verify(self, path: str, content_hash: str, checker: Checker | None = None) -> None:
        """Read a whole file; raise `ArchiveCorrupt` unless its contents have that hash.

        A dataset is read by the process of `checker`, or one of its own: a damaged file can hang or kill
        the HDF5 library.
        """
        if layout.is_dataset(path):
            with nullcontext(checker) if checker else Checker() as reader, self.store.local(path) as file:
                reader.check(file, path, content_hash)
            return
        if not self.has(path):
            raise ArchiveCorrupt(f"{path} is missing from the archive; restore it from a backup")
        found = self._sha256(path)
        if found != content_hash:
            raise altered(path, "it hashes to", f"{found[:12]}...", f"{content_hash[:12]}...")

    def _sha256(self, path: str) -> str:
        with self.store.open(path) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def verify_bytes(self, file: Recorded) -> None:
        """Read a whole file, but not as HDF5; raise `ArchiveCorrupt` unless its bytes are those on record.

        Where they are not on record, its contents are compared, as `verify` does.
        """
        with self.store.local(file.path) as lying:
            _compare_bytes(lying, file)

    def bring(self, file: Recorded, source: Archive) -> None:
        """Copy a sealed file from another archive, a document with its provenance, and compare the copy.

        What lies at its place is replaced, but never by anything else than what is on record.

        Raises
        ------
        ArchiveCorrupt
            When what the other archive has is not that; nothing is changed.
        """
        if not source.has(file.path):
            raise ArchiveCorrupt(f"{file.path} is missing from {source.where}")
        if not layout.is_dataset(file.path):
            source.verify_provenance(file.path, file.content_hash)
            beside = layout.sidecar(file.path)
            with source.local(beside) as original:
                self.store.replace(beside, original, lambda copy: None)
        with source.local(file.path) as original:
            self.store.replace(file.path, original, lambda copy: _compare_bytes(copy, file))

    def adopt(self, path: str, source: Archive, *, link: bool = False) -> None:
        """Take a file over from another archive as it is, unless there is one; nothing of it is compared.

        Raises
        ------
        InvalidInput
            It is to be linked instead of copied, and cannot be.
        """
        if self.has(path):
            return
        advice = "import again without `link`"
        if link:
            self._require_links(advice)
        with self.store.create(path, _ADOPTED) as file, source.local(path) as original:
            file.unlink(missing_ok=True)  # of an import that was interrupted
            copy_or_link(original, file, link, advice)

    def copy_out(self, path: str, target: LocalFile, *, link: bool = False) -> None:
        """Copy a file to somewhere else, or link it there; nothing of it is compared.

        Raises
        ------
        InvalidInput
            It is to be linked instead of copied, and cannot be.
        """
        advice = "export again without `link`"
        if link:
            self._require_links(advice)
        with self.local(path) as original:
            copy_or_link(original, target, link, advice)

    def _require_links(self, advice: str) -> None:
        if not self.store.capabilities.hard_links:
            raise InvalidInput(f"{self.where} cannot have hard links; {advice}")

    def files(self) -> Iterator[str]:
        """Yield the path of every sealed dataset and document, in no order; none that is being written."""
        for relative in self.store.names():
            if layout.is_result(relative):
                yield relative

    def unfinished(self) -> Iterator[tuple[str, str]]:
        """Yield the path of every file that is being written, or was when its job ended, and the job's id."""
        for relative in self.store.names():
            job_id = layout.writer_of(relative.rsplit("/", 1)[-1])
            if job_id is not None:
                yield relative, job_id

    def strays(self) -> Iterator[tuple[str, str]]:
        """Yield the path of every file that is no part of the archive, and why."""
        for relative in self.store.names():
            name = relative.rsplit("/", 1)[-1]
            document = layout.without_sidecar(relative)
            if layout.is_result(relative) or layout.writer_of(name) is not None:
                continue
            if name.startswith(_OF_A_NETWORK_DISK) or relative in layout.OF_A_CRATE:
                continue
            if document == relative or not layout.is_result(document):
                yield relative, "it is no file of this archive, which its name would tell"
            elif not self.store.exists(document):
                yield relative, "the document whose provenance it holds is not there"

    def provenance(self, path: str) -> Provenance | None:
        """Return how a file came about; None when it does not tell."""
        try:
            if layout.is_dataset(path):
                with self.open_unrecorded(path) as dataset:
                    return dataset.provenance
            return self.document_provenance(layout.without_sidecar(path))
        except (ArchiveCorrupt, OtherFormat):
            return None

    def is_of_job(self, path: str, job_id: str) -> bool:
        """Tell whether a job sealed a file."""
        return layout.may_be_of(path.rsplit("/", 1)[-1], job_id) and self._job_of(path) == job_id

    def leftovers(self, job_id: str, within: Subject | None = None) -> tuple[str, ...]:
        """Return every file, sealed or still being written, of a job's attempts so far, in order of path.

        The provenance of a document belongs to it and is named only when the document is not there. With
        `within`, only files about that subject and its parts are looked at, which is much faster.
        """
        found = []
        start = "" if within is None else layout.folder(within)
        short = layout.short_job_id(job_id)
        for relative in self.store.names(start):
            name = relative.rsplit("/", 1)[-1]
            if short not in name:
                continue
            document = layout.without_sidecar(relative)
            if document != relative and self.has(document):
                continue
            if layout.is_temporary_of(name, job_id) or (
                layout.may_be_of(name, job_id) and self._job_of(relative) == job_id
            ):
                found.append(relative)
        return tuple(sorted(found))

    def discard(self, path: str) -> None:
        """Remove a file, if it is there, and a document's provenance with it.

        For what a job left behind, never for a file that the catalogue knows.
        """
        self.store.delete(path, layout.sidecar(path))

    def set_aside(self, path: str) -> str:
        """Move a file, and a document's provenance with it, to where the archive does not look; return where.

        Either may be missing. Nothing is deleted: a person may look at it, and put it back.
        """
        target, number = f"{layout.SET_ASIDE}/{path}", 1
        # Nothing that was set aside before is overwritten, by the provenance that comes along either.
        while self.store.exists(target) or self.store.exists(layout.sidecar(target)):
            number += 1
            target = f"{layout.SET_ASIDE}-{number}/{path}"
        for name, to in ((layout.sidecar(path), layout.sidecar(target)), (path, target)):
            if self.store.exists(name):
                self.store.move(name, to)
        return target

    def _job_of(self, relative: str) -> str | None:
        """Return the id of the job that sealed a file; None when the file does not tell."""
        provenance = self.provenance(relative)
        return None if provenance is None else provenance.job_id


def _compare_bytes(lying: LocalFile, file: Recorded) -> None:
    """Raise `ArchiveCorrupt` unless a file has the bytes, or else the contents, that are on record."""
    if not lying.is_file():
        raise ArchiveCorrupt(f"{file.path} is missing from the archive; restore it from a backup")
    size = lying.stat().st_size
    if size != file.size_bytes:
        raise altered(file.path, "it has", f"{size} bytes", str(file.size_bytes))
    if not file.sha256 and layout.is_dataset(file.path):
        with Checker() as checker:
            checker.check(lying, file.path, file.content_hash)
        return
    found = sha256_of(lying)
    recorded = file.sha256 or file.content_hash
    if found != recorded:
        raise altered(file.path, "its bytes hash to", f"{found[:12]}...", f"{recorded[:12]}...")
