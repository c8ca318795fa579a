"""Arrays of sealed files, of which parts are read."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from math import prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import InvalidInput
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView

Part: TypeAlias = tuple[slice, ...]

MOST_IN_A_TABLE = 1_000_000
"""Values of a table; more are for programs, which read NPY."""
_ONE = re.compile(r"(?P<at>\d{1,12})|(?P<start>\d{0,12}):(?P<stop>\d{0,12})(?::(?P<step>\d{0,12}))?")


@dataclass(frozen=True)
class ArrayPart:
    """A part of an array that is being read.

    Attributes
    ----------
    file, record, name
        Where the array stands.
    part
        Which part: a slice for each axis.
    shape
        Of the part, without the axes of which one place was asked for.
    axes, unit, dtype
        Names of all axes; unit and type of the values.
    pieces
        The values in C order, some MiB at a time; the file is open until the last was taken.
    """

    file: FileView
    record: str
    name: str
    part: Part
    shape: tuple[int, ...]
    axes: tuple[str, ...]
    unit: str
    dtype: np.dtype[Any]
    pieces: Iterator[NDArray[Any]]

    def as_npy(self) -> Iterator[bytes]:
        """Yield the part as a file of NumPy."""
        header = io.BytesIO()
        described = np.lib.format.dtype_to_descr(self.dtype)
        np.lib.format.write_array_header_1_0(
            header, {"descr": described, "fortran_order": False, "shape": self.shape}
        )
        yield header.getvalue()
        for piece in self.pieces:
            yield piece.tobytes()

    def as_table(self) -> Iterator[bytes]:
        """Yield the part as CSV: a line for each value, its place along each axis first.

        Raises `InvalidInput`, before anything else, for more than `MOST_IN_A_TABLE` values.
        """
        count = prod(self.shape)
        if count > MOST_IN_A_TABLE:
            raise InvalidInput(
                f"a table of {self.name} would have {count} lines, and may have {MOST_IN_A_TABLE}; ask for a "
                "smaller part, or for npy"
            )
        return self._lines()

    def _lines(self) -> Iterator[bytes]:
        yield (",".join([*self.axes, f"{self.name} [{self.unit}]"]) + "\n").encode()
        ranges = [range(one.start, one.stop, one.step) for one in self.part]
        places = np.ndindex(*(len(one) for one in ranges))
        for piece in self.pieces:
            lines = []
            for value in piece.ravel().tolist():
                at = [str(one[place]) for one, place in zip(ranges, next(places), strict=True)]
                lines.append(",".join([*at, "" if value != value else str(value)]))
            yield ("\n".join(lines) + "\n").encode() if lines else b""


@dataclass(frozen=True)
class FileArrays:
    """Shape, type, unit, axes and meaning of each array of a file, by record and name."""

    file: FileView
    records: dict[str, Any]


@use_case(Right.READ)
def list_arrays(services: Services, key: str) -> FileArrays:
    """Return what arrays a file has.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It is a document.
    ArchiveCorrupt
        It is not as it was sealed.
    """
    view = dataset_view(services, key)
    with services.archive.open(view) as dataset:
        return FileArrays(view, dataset.describe())


@use_case(Right.READ)
def read_part(services: Services, key: str, record: str, name: str, part: str = "") -> ArrayPart:
    """Return a part of an array, which is read while it is taken, and verified as it is read.

    Parameters
    ----------
    part
        As "0:3,100:200,::4": places, or begin:end:step, for each axis; what is left out is whole.

    Raises
    ------
    NotFound
        There is no such file, record or array.
    InvalidInput
        It is a document, or the part is none of the array.
    ArchiveCorrupt
        It is not as it was sealed.
    """
    view = dataset_view(services, key)
    with ExitStack() as opened:
        dataset = opened.enter_context(services.archive.open(view))
        stored = opened.enter_context(dataset.array(record, name))
        about = dataset.describe()[record][name]
        chosen, single = _part(part, stored.shape)
        # The first piece is read here, so that what is wrong with the file is told before anything is given.
        pieces = _taken(opened.pop_all(), stored.pieces(chosen))
    next(pieces)
    shape = [len(range(one.start, one.stop, one.step)) for one in chosen]
    return ArrayPart(
        view,
        record,
        name,
        chosen,
        tuple(length for place, length in enumerate(shape) if place not in single),
        tuple(about["axes"]),
        about["unit"],
        stored.dtype,
        pieces,
    )


@use_case(Right.READ)
def dataset_view(services: Services, key: str) -> FileView:
    """Return a file that holds records; raise `NotFound`, and `InvalidInput` for a document."""
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    if view.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(f"file {view.id} is a {view.media_type} document, which holds no arrays")
    return view


def _taken(opened: ExitStack, pieces: Iterator[NDArray[Any]]) -> Iterator[Any]:
    """Yield nothing once the first piece is read, and then all of them; close the file at the end."""
    with opened:
        first = next(pieces)
        yield None
        yield first
        yield from pieces


def _part(text: str, shape: tuple[int, ...]) -> tuple[Part, set[int]]:
    """Return a slice for each axis, and the axes of which one place is asked for."""
    texts = text.split(",") if text else []
    if len(texts) > len(shape):
        raise InvalidInput(f"the part {text!r:.80} has {len(texts)} axes, and the array {len(shape)}")
    part, single = [], set()
    for axis, length in enumerate(shape):
        found = _ONE.fullmatch(texts[axis].strip() or ":") if axis < len(texts) else _ONE.fullmatch(":")
        if found is None:
            raise InvalidInput(f"'{texts[axis]:.40}' is no part of an axis; write 7, or 100:200, or 0:200:4")
        if found["at"]:
            place = int(found["at"])
            if place >= length:
                raise InvalidInput(f"there is no place {place} along axis {axis}, which has {length}")
            single.add(axis)
            part.append(slice(place, place + 1, 1))
            continue
        step = int(found["step"] or 1)
        if step < 1:
            raise InvalidInput(f"the step of {texts[axis]!r:.40} is 0; give 1 or more")
        start, stop, _ = slice(int(found["start"] or 0), int(found["stop"] or length)).indices(length)
        part.append(slice(start, max(start, stop), step))
    return tuple(part), single
