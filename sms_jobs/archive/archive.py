"""The archive: a folder of sealed files that never change."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py

from sms_jobs.archive import hdf5, layout
from sms_jobs.archive.checking import Checker
from sms_jobs.archive.dataset import ArchivedDataset, altered, check_dataset, open_dataset
from sms_jobs.archive.limits import LARGEST_TEXT_BYTES
from sms_jobs.archive.place import probe
from sms_jobs.archive.provenance import (
    Found,
    Provenance,
    Recorded,
    Sealed,
    digest_of,
    provenance_from_json,
    provenance_to_json,
)
from sms_jobs.archive.sealing import copy_file, make_folders, safe_file, sealing, sha256_of, sync
from sms_jobs.errors import ArchiveCorrupt, ConfigurationError, InvalidInput, OtherFormat
from sms_jobs.records.campaign import Subject

DATASET_MEDIA_TYPE = "application/x-hdf5"


_COMPARED_FIRST_BYTES = 256 << 10
"""A file of at most so much is compared as a whole before HDF5 sees it, which some damage makes spin.

Most of a small file is what HDF5 finds its way by; of a large one that is next to nothing, and arrays, which
are compared when they are read.
"""
_OF_A_NETWORK_DISK = ".nfs"
"""Begins the names of files that are removed while somebody still reads them; they go by themselves."""


class Archive:
    """A folder of sealed files.

    A sealed file is complete, checked and on the disk before it has its name, and is never changed or
    overwritten afterwards. Paths are relative to the folder, with forward slashes.
    """

    def __init__(self, root: Path) -> None:
        """Use the archive in the folder `root`, which is created if it is not there.

        Raises `ConfigurationError` where there can be no such folder.
        """
        try:
            root.mkdir(parents=True, exist_ok=True)
            self.root = root.resolve()
        except (OSError, RuntimeError, ValueError) as error:
            raise ConfigurationError(
                f"there can be no archive at {root} ({getattr(error, 'strerror', error)}); correct the "
                "setting 'archive'"
            ) from error

    def probe(self, subject: Subject | None = None) -> None:
        """Find out whether files can be kept, and where those of a subject lie.

        Raises
        ------
        StorageFull, StorageUnusable
            They cannot.
        """
        probe(self.root)
        if subject is not None:
            lies = self.root / layout.folder(subject)
            probe(next(f for f in (lies, *lies.parents) if f == self.root or os.path.lexists(f)))

    def path(self, relative: str) -> Path:
        """Return the file at a relative path; raise `InvalidInput` when it is outside the archive."""
        return layout.inside(self.root, relative)

    def _new(self, relative: str) -> Path:
        """Return where a new file goes: its folder with links followed, its own name as it is."""
        path = self.root / relative
        return layout.inside(self.root, str(Path(relative).parent)) / path.name

    def seal_dataset(self, records: Mapping[str, Any], provenance: Provenance) -> Sealed:
        """Store records in one HDF5 file; the first is shown when the file is opened in a viewer.

        Raises
        ------
        Conflict
            When the job's attempt has sealed a file of that name already.
        StorageFull
            When the disk is full; nothing is left behind, as on every other error.
        """
        relative = layout.dataset_path(provenance)
        path = self._new(relative)
        with sealing(self.root, path, layout.identity(provenance)) as temporary:
            with safe_file(temporary) as raw, h5py.File(raw, "w", libver=hdf5.LIBRARY_VERSIONS) as file:
                content_hash = hdf5.write(file, records, provenance)
            sync(temporary)
            with ThreadPoolExecutor(1) as meanwhile:
                sha256 = meanwhile.submit(sha256_of, temporary)
                check_dataset(temporary, relative, content_hash)
            size = temporary.stat().st_size
        return Sealed(relative, content_hash, size, DATASET_MEDIA_TYPE, sha256.result())

    def seal_document(
        self, filename: str, media_type: str, write: Callable[[Path], None], provenance: Provenance
    ) -> Sealed:
        """Store a file that `write` fills at the path that it is given, and its provenance beside it.

        The file is called `<kind>-<time>-<job>-<attempt>-<filename>`. Raises as `seal_dataset` does.
        """
        relative = layout.document_path(provenance, filename)
        path = self._new(relative)
        job = layout.identity(provenance)
        with sealing(self.root, path, job) as temporary:
            write(temporary)
            if not temporary.is_file():
                raise InvalidInput(f"nothing was written for {filename} of {provenance.subject}")
            sha256, size = sha256_of(temporary), temporary.stat().st_size
            sealed = Sealed(relative, sha256, size, media_type, sha256)
            about = {
                "format": f"{hdf5.FORMAT}-document",
                "format_version": hdf5.FORMAT_VERSION,
                "filename": filename,
                "media_type": media_type,
                "content_hash": sealed.content_hash,
                "provenance": json.loads(provenance_to_json(provenance)),
            }
            about["sha256"] = digest_of(about)
            # First, so that no document is ever without its provenance.
            with sealing(self.root, path.with_name(layout.sidecar(path.name)), job) as beside:
                beside.write_text(json.dumps(about, indent=1), encoding="utf-8")
        return sealed

    def with_free_name(self, provenance: Provenance) -> Provenance:
        """Return a provenance with the first attempt from its own on whose dataset is not there."""
        while self.path(layout.dataset_path(provenance)).exists():
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
        path = self.path(file.path)
        if file.sha256 and file.size_bytes <= _COMPARED_FIRST_BYTES:
            self.verify_bytes(file)
        return open_dataset(path, file.path, file.content_hash, file.size_bytes)

    def open_unrecorded(self, path: str) -> AbstractContextManager[ArchivedDataset]:
        """Open a dataset file of which nothing is on record; it must be what it says of itself.

        Raises as `open` does.
        """
        return open_dataset(self.path(path), path)

    def document_provenance(self, path: str) -> Provenance:
        """Return how a document came about; raise `ArchiveCorrupt` when that is not known."""
        return self._beside(path)[0]

    def _beside(self, path: str) -> tuple[Provenance, str, str]:
        """Return provenance, content hash and media type of a document, as they stand beside it."""
        beside = self.path(layout.sidecar(path))
        if not beside.is_file() or beside.stat().st_size > LARGEST_TEXT_BYTES:
            raise ArchiveCorrupt(f"the provenance of {path} is missing; restore {beside}")
        try:
            about = json.loads(beside.read_bytes())
            version = int(about["format_version"])
            told = about["provenance"], str(about["content_hash"]), str(about["media_type"])
            # Files of older programs have none.
            whole = about.pop("sha256", None) in (None, digest_of(about))
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise ArchiveCorrupt(f"the provenance of {path} cannot be read; restore {beside}") from error
        if not whole:
            raise ArchiveCorrupt(f"the provenance of {path} was altered; restore {beside}")
        hdf5.require_version(path, version)
        return provenance_from_json(json.dumps(told[0]), path), *told[1:]

    def verify_provenance(self, path: str, content_hash: str) -> None:
        """Raise `ArchiveCorrupt` unless what lies beside a document is whole and of those contents."""
        told = self._beside(path)[1]
        if told != content_hash:
            raise ArchiveCorrupt(
                f"what lies beside {path} is of contents that hash to {told[:12]}..., but "
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
        file = self.path(path)
        sealed = Sealed(path, content_hash, file.stat().st_size, media_type, sha256_of(file))
        return Found(sealed, provenance)

    def verify(self, path: str, content_hash: str, checker: Checker | None = None) -> None:
        """Read a whole file; raise `ArchiveCorrupt` unless its contents have that hash.

        A dataset is read by the process of `checker`, or one of its own: a damaged file can hang or kill
        the HDF5 library.
        """
        file = self.path(path)
        if layout.is_dataset(path):
            with nullcontext(checker) if checker else Checker() as reader:
                reader.check(file, path, content_hash)
            return
        if not file.is_file():
            raise ArchiveCorrupt(f"{path} is missing from the archive; restore it from a backup")
        found = sha256_of(file)
        if found != content_hash:
            raise altered(path, "it hashes to", f"{found[:12]}...", f"{content_hash[:12]}...")

    def verify_bytes(self, file: Recorded) -> None:
        """Read a whole file, but not as HDF5; raise `ArchiveCorrupt` unless its bytes are those on record.

        Where they are not on record, its contents are compared, as `verify` does.
        """
        self._compare_bytes(self.path(file.path), file)

    def _compare_bytes(self, lying: Path, file: Recorded) -> None:
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
        wanted = file.sha256 or file.content_hash
        if found != wanted:
            raise altered(file.path, "its bytes hash to", f"{found[:12]}...", f"{wanted[:12]}...")

    def bring(self, file: Recorded, source: Archive) -> None:
        """Copy a sealed file from another archive, a document with its provenance, and compare the copy.

        What lies at its place is replaced, but never by anything else than what is on record.

        Raises
        ------
        ArchiveCorrupt
            When what the other archive has is not that; nothing is changed.
        """
        if not source.path(file.path).is_file():
            raise ArchiveCorrupt(f"{file.path} is missing from {source.root}")
        if not layout.is_dataset(file.path):
            source.verify_provenance(file.path, file.content_hash)
            beside = layout.sidecar(file.path)
            copy_file(source.path(beside), self._new(beside))
        copy_file(source.path(file.path), self._new(file.path), lambda copy: self._compare_bytes(copy, file))

    def files(self) -> Iterator[str]:
        """Yield the path of every sealed dataset and document, in no order; none that is being written."""
        for relative in self._names():
            if layout.is_result(relative):
                yield relative

    def unfinished(self) -> Iterator[tuple[str, str]]:
        """Yield the path of every file that is being written, or was when its job ended, and the job's id."""
        for relative in self._names():
            job_id = layout.writer_of(relative.rsplit("/", 1)[-1])
            if job_id is not None:
                yield relative, job_id

    def strays(self) -> Iterator[tuple[str, str]]:
        """Yield the path of every file that is no part of the archive, and why."""
        for relative in self._names():
            name = relative.rsplit("/", 1)[-1]
            document = layout.without_sidecar(relative)
            if layout.is_result(relative) or layout.writer_of(name) is not None:
                continue
            if name.startswith(_OF_A_NETWORK_DISK) or relative in layout.OF_A_CRATE:
                continue
            if document == relative or not layout.is_result(document):
                yield relative, "it is no file of this archive, which its name would tell"
            elif not os.path.lexists(self.root / document):
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
        start = "." if within is None else str(layout.folder(within))
        short = layout.short_job_id(job_id)
        for relative in self._names(start):
            name = relative.rsplit("/", 1)[-1]
            if short not in name:
                continue
            document = layout.without_sidecar(relative)
            if document != relative and self.path(document).is_file():
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
        file = self.path(path)
        if not file.parent.is_dir():
            return
        file.unlink(missing_ok=True)
        file.with_name(layout.sidecar(file.name)).unlink(missing_ok=True)
        sync(file.parent)

    def set_aside(self, path: str) -> str:
        """Move a file, and a document's provenance with it, to where the archive does not look; return where.

        It is never deleted: a person may look at it, and put it back.
        """
        source = self._new(path)
        wanted = self.root / layout.SET_ASIDE / path
        number = 1
        # Nothing that was set aside before is overwritten, by the provenance that comes along either.
        while os.path.lexists(wanted) or os.path.lexists(layout.sidecar(str(wanted))):
            number += 1
            wanted = self.root / f"{layout.SET_ASIDE}-{number}" / path
        make_folders(self.root, wanted.parent)
        beside = source.with_name(layout.sidecar(source.name))
        if beside.is_file():
            beside.replace(wanted.with_name(layout.sidecar(wanted.name)))
        source.replace(wanted)
        sync(wanted.parent)
        sync(source.parent)
        return wanted.relative_to(self.root).as_posix()

    def _names(self, start: str = ".") -> Iterator[str]:
        """Yield the relative path of every file below a folder; links to folders are not followed."""
        for folder, inside, names in os.walk(self.path(start)):
            inside[:] = [name for name in inside if not name.startswith(".")]
            inner = Path(folder).relative_to(self.root).as_posix()
            for name in names:
                yield name if inner == "." else f"{inner}/{name}"

    def _job_of(self, relative: str) -> str | None:
        """Return the id of the job that sealed a file; None when the file does not tell."""
        provenance = self.provenance(relative)
        return None if provenance is None else provenance.job_id
