"""A sealed dataset file, open for reading."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from sms_jobs.archive import hdf5
from sms_jobs.archive.codec import class_named, layout_of, record_from_parts
from sms_jobs.archive.limits import refuse_excess
from sms_jobs.archive.provenance import Provenance, provenance_from_json
from sms_jobs.errors import ArchiveCorrupt, FormatTooNew, InvalidInput, NotFound
from sms_jobs.records.campaign import Subject

R = TypeVar("R")

_BROKEN = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, MemoryError)
"""What h5py raises, or the code that follows it, when the bytes of a file make no sense."""


@contextmanager
def readable(where: str) -> Iterator[None]:
    """Turn what h5py raises on damaged files into `ArchiveCorrupt`."""
    try:
        yield
    except _BROKEN as error:
        reason = re.sub(r"\s+", " ", str(error))[:200]
        raise ArchiveCorrupt(f"{where} cannot be read ({reason}); restore it from a backup") from error


@dataclass(frozen=True)
class StoredFrames:
    """Frames in a sealed file, read when they are asked for, as long as the file is open."""

    _dataset: Any
    _where: str

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        frames, rows, columns = self._dataset.shape
        return frames, rows, columns

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16."""
        dtype: np.dtype[Any] = self._dataset.dtype
        return dtype

    def frame(self, index: int) -> NDArray[Any]:
        """Return one frame, (rows, columns)."""
        with readable(self._where):
            frame: NDArray[Any] = self._dataset[index]
        return frame

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        with readable(self._where):
            slab: NDArray[Any] = self._dataset[:, start:stop]
        return slab


@contextmanager
def _opened(file: Path, where: str) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading and check that it is one of ours, of a version that we read."""
    if not file.is_file():
        raise ArchiveCorrupt(f"{where} is missing from the archive; restore it from a backup")
    with readable(where):
        opened = h5py.File(file, "r")
    with opened:
        with readable(where):
            known = opened.attrs.get("format") == hdf5.FORMAT
            version = int(opened.attrs.get("format_version", 0))
        if not known:
            raise ArchiveCorrupt(f"{where} is an HDF5 file, but not one of this archive")
        if version > hdf5.FORMAT_VERSION:
            raise FormatTooNew(
                f"{where} has format version {version}, this program reads up to {hdf5.FORMAT_VERSION}; "
                "install a newer sms_jobs"
            )
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
        As recorded in the file.
    names
        Of the records it holds, in order.
    """

    path: str
    provenance: Provenance
    content_hash: str
    names: tuple[str, ...]
    _file: Path
    _streams: ExitStack

    @property
    def subject(self) -> Subject:
        """What the file is about."""
        return self.provenance.subject

    def _group(self, name: str, until: ExitStack) -> Any:
        """Open the file and return the group of a record, valid until the stack is closed."""
        if name not in self.names:
            raise NotFound(f"{self.path} has no record '{name}'; it has {', '.join(self.names)}")
        opened = until.enter_context(_opened(self._file, self.path))
        with readable(self.path):
            return opened["entry"][name]

    def record_class(self, name: str) -> type:
        """Return the class of a record."""
        with ExitStack() as briefly, readable(self.path):
            stored = str(self._group(name, briefly).attrs["record"])
        return class_named(stored, self.path)

    def describe(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return shape, unit and meaning of every array, by record and field, without reading any."""
        about: dict[str, dict[str, dict[str, Any]]] = {}
        for name in self.names:
            arrays = layout_of(self.record_class(name)).arrays
            with ExitStack() as briefly, readable(self.path):
                group = self._group(name, briefly)
                about[name] = {
                    field_name: {
                        "shape": list(group[field_name].shape),
                        "unit": field.quantity.unit,
                        "meaning": field.quantity.meaning,
                    }
                    for field_name, field in arrays.items()
                    if field_name in group
                }
        return about

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
            stored = group.attrs["record"]
            if stored != record.__name__:
                raise InvalidInput(f"{where} is a {stored}, not a {record.__name__}")
            plain = hdf5.read_text(group[hdf5.FIELDS])
            present = set(group.attrs["arrays"])
            for field_name, field in declared.items():
                if field_name not in present and field.optional:
                    continue
                if field_name not in present:
                    raise ArchiveCorrupt(f"{where} has no {field_name}; was it written by another version?")
                dataset = group[field_name]
                if field.dtype is not None and dataset.dtype != field.dtype:
                    raise ArchiveCorrupt(f"{where}.{field_name} is {dataset.dtype}, not {field.dtype}")
                arrays[field_name] = StoredFrames(dataset, where) if field.streamed else dataset[...]
        return record_from_parts(record, plain, arrays, where)


@contextmanager
def open_dataset(file: Path, where: str) -> Iterator[ArchivedDataset]:
    """Open a sealed dataset file; `where` is its path in the archive, for messages.

    Raises
    ------
    ArchiveCorrupt
        When it is missing, truncated, or not a file of the archive.
    FormatTooNew
        When it was written by a newer version.
    """
    with _opened(file, where) as opened, readable(where):
        entry = opened["entry"]
        text = hdf5.read_text(entry[hdf5.PROCESS]["provenance"])
        names = tuple(str(name) for name in entry.attrs["records"])
        recorded = str(opened.attrs["content_hash"])
    with ExitStack() as streams:
        yield ArchivedDataset(where, provenance_from_json(text, where), recorded, names, file, streams)


def check_dataset(file: Path, where: str, content_hash: str) -> None:
    """Read everything in a dataset file; raise `ArchiveCorrupt` unless it has that content hash."""
    with _opened(file, where) as opened, readable(where):
        refuse_excess(opened)
        found = hdf5.content_hash(opened)
        whole = hdf5.provenance_is_whole(opened)
        recorded = str(opened.attrs["content_hash"])
    if content_hash not in (found, "") or recorded != found:
        raise ArchiveCorrupt(
            f"the contents of {where} hash to {found[:12]}..., but {(content_hash or recorded)[:12]}... "
            "is on record; restore it from a backup"
        )
    if not whole:
        raise ArchiveCorrupt(f"the provenance in {where} was altered; restore the file from a backup")
