"""A sealed dataset file, open for reading."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from sms_jobs.archive import hdf5
from sms_jobs.archive.arrays import StoredArray, stored_array
from sms_jobs.archive.codec import class_named, layout_of, record_from_parts
from sms_jobs.archive.damage import altered, differs, readable
from sms_jobs.archive.form import DATASET_MEDIA_TYPE, FORMAT, require_version
from sms_jobs.archive.hashing import RecordDigest, manifest_from
from sms_jobs.archive.limits import refuse_excess
from sms_jobs.archive.provenance import Provenance, Sealed, digest, provenance_from_json
from sms_jobs.archive.sealing import safe_file, sha256_of, sync
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, NotFound
from sms_jobs.records.quantity import components_of
from sms_jobs.records.subject import Subject

R = TypeVar("R")


@dataclass(frozen=True)
class StoredFrames:
    """Frames in a sealed file, read when they are asked for, as long as the file is open.

    They are read in whole blocks, each of which is compared with its check.
    """

    _array: StoredArray

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        frames, rows, columns = self._array.shape
        return frames, rows, columns

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16."""
        return self._array.dtype

    def frame(self, index: int) -> NDArray[Any]:
        """Return one frame, (rows, columns)."""
        index = range(self.shape[0])[index]
        first = index - index % self._array.grid.block[0]
        frame: NDArray[Any] = self._blocks(first, 0, self.shape[1])[index - first]
        return frame

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        count, rows, columns = self.shape
        start, stop, _ = slice(start, stop).indices(rows)
        depth, height, _ = self._array.grid.block
        top, bottom = start - start % height, min(-(-stop // height) * height, rows)
        if (top, bottom) == (start, stop):
            return self._array.whole_blocks((slice(0, count, 1), slice(top, bottom, 1), slice(0, columns, 1)))
        slab = np.empty((count, max(stop - start, 0), columns), self.dtype)
        for first in range(0, count, depth):
            slab[first : first + depth] = self._blocks(first, top, bottom)[:, start - top : stop - top]
        return slab

    def _blocks(self, first: int, top: int, bottom: int) -> NDArray[Any]:
        """Return whole rows of the frames of one block, the first of which is given."""
        count, _, columns = self.shape
        last = min(first + self._array.grid.block[0], count)
        return self._array.whole_blocks((slice(first, last, 1), slice(top, bottom, 1), slice(0, columns, 1)))


@contextmanager
def _opened(file: Path, where: str) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading and check that it is one of ours, of a version that we read."""
    if not file.is_file():
        raise ArchiveCorrupt(f"{where} is missing from the archive; restore it from a backup")
    with readable(where):
        opened = h5py.File(file, "r")
    with opened:
        with readable(where):
            ours = opened.attrs.get("format") == FORMAT
            version = int(opened.attrs.get("format_version", 0))
        if not ours:
            raise ArchiveCorrupt(f"{where} is an HDF5 file, but not one of this archive")
        require_version(where, version)
        yield opened


@dataclass(frozen=True)
class ArchivedDataset:
    """A dataset file of the archive, for reading.

    The file itself is open only while a record is read, and as long as frames are streamed from it: a
    report reads hundreds of datasets, more than a process may have open.

    Attributes
    ----------
    path
        Relative to the archive.
    provenance
        How it came about.
    content_hash
        Of its contents.
    names
        Of the records it holds, in order.
    """

    path: str
    provenance: Provenance
    content_hash: str
    names: tuple[str, ...]
    _file: Path
    _manifest: Mapping[str, RecordDigest]
    _streams: ExitStack

    @property
    def subject(self) -> Subject:
        """What the file is about."""
        return self.provenance.subject

    def _no_record(self, name: str) -> NotFound:
        return NotFound(f"{self.path} has no record '{name}'; it has {', '.join(self.names)}")

    def _group(self, name: str, until: ExitStack) -> Any:
        """Open the file and return the group of a record, valid until the stack is closed."""
        if name not in self.names:
            raise self._no_record(name)
        opened = until.enter_context(_opened(self._file, self.path))
        with readable(self.path):
            group = opened["entry"][name]
            plain = hdf5.read_text(group[hdf5.FIELDS])
        if plain != self._manifest[name]["fields"]:
            raise differs(f"{self.path}:{name}", plain, self._manifest[name]["fields"])
        return group

    def record_class(self, name: str) -> type:
        """Return the class of a record."""
        if name not in self.names:
            raise self._no_record(name)
        return class_named(self._manifest[name]["record"], self.path)

    def describe(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return what is known of every array, by record and field, without reading any."""
        about: dict[str, dict[str, dict[str, Any]]] = {}
        for name in self.names:
            arrays = layout_of(self.record_class(name)).arrays
            stated = {array["name"]: array for array in self._manifest[name]["arrays"]}
            with ExitStack() as briefly, readable(self.path):
                group = self._group(name, briefly)
                about[name] = {
                    field_name: {
                        "shape": list(group[field_name].shape),
                        "dtype": stated[field_name]["dtype"],
                        "unit": stated[field_name]["unit"],
                        "axes": list(field.quantity.axes),
                        "components": list(components_of(field.quantity, group[field_name].shape)),
                        "meaning": field.quantity.meaning,
                    }
                    for field_name, field in arrays.items()
                    if field_name in group
                }
        return about

    def parts_of(self, name: str) -> tuple[str, str]:
        """Return the class of a record and its plain fields as JSON; raise `NotFound` where there is none."""
        if name not in self.names:
            raise self._no_record(name)
        return self._manifest[name]["record"], self._manifest[name]["fields"]

    @contextmanager
    def array(self, record: str, name: str) -> Iterator[StoredArray]:
        """Give an array of a record, of which parts are read and verified; frames too.

        Raises
        ------
        NotFound
            The file has no such record, or the record no such array.
        ArchiveCorrupt
            It cannot be read, or is not what was sealed.
        """
        where = f"{self.path}:{record}"
        with ExitStack() as until:
            group = self._group(record, until)
            present = {one["name"]: one for one in self._manifest[record]["arrays"]}
            if name not in present:
                raise NotFound(f"{where} has no array '{name}'; it has {', '.join(present)}")
            with readable(where):
                found = stored_array(group[name], present[name], f"{where}.{name}")
            yield found

    def read(self, name: str, record: type[R]) -> R:
        """Read one record; frame stacks stay in the file and are streamed.

        Raises
        ------
        NotFound
            When the file has no record of that name.
        InvalidInput
            When it is of another class.
        ArchiveCorrupt
            When it cannot be read, or does not fit its class.
        """
        where = f"{self.path}:{name}"
        declared = layout_of(record).arrays
        streamed = any(field.streamed for field in declared.values())
        arrays: dict[str, Any] = {}
        with ExitStack() as briefly, readable(where):
            group = self._group(name, self._streams if streamed else briefly)
            entry = self._manifest[name]
            if entry["record"] != record.__name__:
                raise InvalidInput(f"{where} is a {entry['record']}, not a {record.__name__}")
            present = {one["name"]: one for one in entry["arrays"]}
            for field_name, field in declared.items():
                if field_name not in present and field.optional:
                    continue
                if field_name not in present:
                    raise ArchiveCorrupt(f"{where} has no {field_name}; was it written by another version?")
                dataset = group[field_name]
                if field.dtype is not None and dataset.dtype != field.dtype:
                    raise ArchiveCorrupt(f"{where}.{field_name} is {dataset.dtype}, not {field.dtype}")
                array = stored_array(dataset, present[field_name], f"{where}.{field_name}")
                arrays[field_name] = StoredFrames(array) if field.streamed else array.whole()
        return record_from_parts(record, entry["fields"], arrays, where)


@contextmanager
def open_dataset(
    file: Path, where: str, content_hash: str = "", size_bytes: int | None = None
) -> Iterator[ArchivedDataset]:
    """Open a sealed dataset file and see that it is the one that was sealed, as far as it is read.

    Texts and digests, some kilobytes, are compared with the content hash at once, and every array with its
    digest when it is read.

    Parameters
    ----------
    file, where
        Where it lies; its path in the archive, for messages.
    content_hash, size_bytes
        As they are on record; what the file says of itself if they are not.

    Raises
    ------
    ArchiveCorrupt
        When it is missing, truncated, not a file of the archive, or another one than was sealed.
    OtherFormat
        When it was written by a newer version.
    """
    if size_bytes is not None and file.is_file() and file.stat().st_size != size_bytes:
        raise altered(where, "it has", f"{file.stat().st_size} bytes", str(size_bytes))
    with _opened(file, where) as opened, readable(where):
        process = opened["entry"][hdf5.PROCESS]
        text = hdf5.read_text(process["provenance"])
        whole = digest(text) == process.attrs["sha256"]
        manifest = hdf5.stored_manifest(opened)
        recorded = str(opened.attrs["content_hash"])
    found = digest(manifest)
    _compare(where, found, recorded, content_hash)
    if not whole:
        raise ArchiveCorrupt(f"the provenance in {where} was altered; restore the file from a backup")
    entries = {one["name"]: one for one in manifest_from(manifest)}
    with ExitStack() as streams:
        yield ArchivedDataset(
            where, provenance_from_json(text, where), recorded, tuple(entries), file, entries, streams
        )


def write_dataset(file: Path, where: str, records: Mapping[str, Any], provenance: Provenance) -> Sealed:
    """Write records to a new file, force it to the disk, read it back and compare; return what it is.

    Parameters
    ----------
    file, where
        What is written; the path in the archive that it will have.

    Raises
    ------
    ArchiveCorrupt
        The disk does not keep what is written.
    OSError
        It cannot be written.
    """
    with safe_file(file) as raw, h5py.File(raw, "w", libver=hdf5.LIBRARY_VERSIONS) as opened:
        content_hash = hdf5.write(opened, records, provenance)
    sync(file)
    with ThreadPoolExecutor(1) as meanwhile:
        sha256 = meanwhile.submit(sha256_of, file)
        check_dataset(file, where, content_hash)
    return Sealed(where, content_hash, file.stat().st_size, DATASET_MEDIA_TYPE, sha256.result())


def check_dataset(file: Path, where: str, content_hash: str) -> None:
    """Read everything in a dataset file; raise `ArchiveCorrupt` unless it has that content hash."""
    with _opened(file, where) as opened, readable(where):
        refuse_excess(opened)
        stored = digest(hdf5.stored_manifest(opened))
        found = digest(hdf5.found_manifest(opened))
        whole = hdf5.provenance_is_whole(opened)
        recorded = str(opened.attrs["content_hash"])
    _compare(where, found, recorded, stored)
    _compare(where, found, recorded, content_hash)
    if not whole:
        raise ArchiveCorrupt(f"the provenance in {where} was altered; restore the file from a backup")


def _compare(where: str, found: str, recorded: str, expected: str) -> None:
    """Raise `ArchiveCorrupt` unless a hash is the one in the file, and the expected one if there is one."""
    if expected not in (found, "") or recorded != found:
        raise altered(where, "its contents hash to", f"{found[:12]}...", f"{(expected or recorded)[:12]}...")
