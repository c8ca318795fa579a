"""Where the fields of a file are: what can be shown of it, and samples of that."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, Any, TypeAlias

from numpy.typing import NDArray

from sms_jobs.app.holdings.inputs import inputs_at
from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import family, search
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.kinds.port_names import AT_REST, MOVED, SHAPE
from sms_jobs.records.field_names import DISPLACEMENT_LENGTH, DISPLACEMENT_XYZ, POSITION, POSITION_XYZ
from sms_jobs.records.people import Right
from sms_jobs.records.record_names import RecordName
from sms_jobs.records.shown.files import FileView

if TYPE_CHECKING:
    from sms_jobs.formats.drawing.quantities import Reading, Shown

SAMPLES = 640
"""Most samples of a map along its longer side, unless somebody asks for others."""
Window: TypeAlias = tuple[int, int, int, int]
"""First row and column of a part of an image, and how many of each."""


@dataclass(frozen=True)
class Placed:
    """A quantity, the file that it is in, and (rows, columns) of its image."""

    file: FileView
    shown: Shown
    size: tuple[int, int]


@dataclass(frozen=True)
class Fields:
    """What can be shown of a file.

    Attributes
    ----------
    file
        Of the archive.
    part, parts
        Which of the groups of records, each over one camera's image, and all there are.
    placed
        Its own quantities, the most telling first, then where its pixels are and how they moved.
    """

    file: FileView
    part: str
    parts: tuple[str, ...]
    placed: tuple[Placed, ...]

    @property
    def names(self) -> frozenset[str]:
        """Names of all quantities."""
        return frozenset(one.shown.name for one in self.placed)

    @property
    def position(self) -> tuple[str, ...] | None:
        """Names of the quantities that are X, Y, Z of the surface; None where it has none in space."""
        return self._three(POSITION_XYZ)

    @property
    def movement(self) -> tuple[str, ...] | None:
        """Names of the quantities that are its displacement along X, Y, Z; None without."""
        return self._three(DISPLACEMENT_XYZ)

    def _three(self, names: tuple[str, ...]) -> tuple[str, ...] | None:
        return names if self.names.issuperset(names) else None

    def named(self, name: str) -> Placed:
        """Return a quantity; raise `NotFound` where there is none of that name."""
        found = next((one for one in self.placed if one.shown.name == name), None)
        if found is None:
            known = ", ".join(one.shown.name for one in self.placed)
            raise NotFound(f"file {self.file.id} has no quantity '{name}' over an image; it has {known}")
        return found


@use_case(Right.READ)
def fields_of(services: Services, key: str, part: str | None = None) -> Fields:
    """Return what can be shown of a file, without reading any of it.

    Raises
    ------
    NotFound
        There is no such file, or it has no such part.
    InvalidInput
        It has no field over an image.
    """
    with services.catalogue.reading() as session:
        file = search.file_view(session, key)
        near = family.ancestry(session, file).inputs
    if file.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(f"file {key} is a {file.media_type} document and has no fields; open it as it is")
    parts = _parts(services, file)
    if not parts:
        raise InvalidInput(
            f"file {key} ({file.source}) has no field over an image; choose a measurement or a result"
        )
    if part and part not in parts:
        raise no_part(key, part, parts)
    chosen = part or next(iter(parts))
    placed = parts[chosen]
    for quantity, along_x, others in (
        (POSITION, POSITION_XYZ[0], inputs_at(near, AT_REST, SHAPE)),
        (DISPLACEMENT_LENGTH, DISPLACEMENT_XYZ[0], inputs_at(near, MOVED)),
    ):
        if others and along_x not in {one.shown.name for one in placed}:
            placed = [*placed, *_lent(services, others[0], quantity, placed)]
    return Fields(file, chosen, tuple(parts), tuple(placed))


def _lent(services: Services, other: FileView, quantity: str, placed: list[Placed]) -> list[Placed]:
    """Return the components of a quantity that another file has of the same pixels."""
    if other.media_type != DATASET_MEDIA_TYPE:
        return []
    own = {one.shown.name for one in placed}
    found = [one for part in _parts(services, other).values() for one in part]
    return [
        one
        for one in found
        if one.shown.quantity == quantity
        and one.shown.component is not None
        and one.size == placed[0].size
        and one.shown.name not in own
    ]


def no_part(key: str, part: str, parts: Iterable[str]) -> NotFound:
    """Return the error that says that a file has no such part, and which parts it has."""
    known = ", ".join(filter(None, parts))
    return NotFound(
        f"file {key} has no part '{part}'; {f'it has {known}' if known else 'leave the part out'}"
    )


def _parts(services: Services, file: FileView) -> dict[str, list[Placed]]:
    """Return what can be shown of a file, by camera where its records are of several."""
    from sms_jobs.formats.drawing.quantities import shown_of

    with services.archive.open(file) as dataset:
        described = dataset.describe()
    parts: dict[str, list[Placed]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for record, arrays in described.items():
        part = RecordName.parse(record).key
        for shown in shown_of(record, arrays):
            array = arrays[shown.values.sources[0][0]]
            size = (array["shape"][-2], array["shape"][-1])
            taken = {one.shown.name for one in parts.get(part, ())}
            if sizes.setdefault(part, size) == size and shown.name not in taken:
                parts.setdefault(part, []).append(Placed(file, shown, size))
    return parts


def step_of(size: tuple[int, int], samples: int) -> int:
    """Return every how many pixels is sampled for so many along the longer side."""
    return max(1, ceil(max(size) / samples))


def sampled(
    archive: Archive,
    one: Placed,
    readings: Sequence[Reading],
    step: int,
    *,
    window: Window | None = None,
) -> list[NDArray[Any]]:
    """Return every `step`th pixel of what readings make, the middle ones."""
    half = step // 2
    top, left, rows, columns = window or (0, 0, *one.size)
    down, across = slice(top + half, top + rows, step), slice(left + half, left + columns, step)
    return read(archive, one, readings, down, across)


def read(
    archive: Archive, one: Placed, readings: Sequence[Reading], rows: slice, columns: slice
) -> list[NDArray[Any]]:
    """Return what readings make of some rows and columns; what two of them need is read once.

    Raises `ArchiveCorrupt` where the file is not what was sealed.
    """
    shape = tuple(len(range(s.start, s.stop, s.step)) for s in (rows, columns))
    images: dict[tuple[str, int | None], NDArray[Any]] = {}
    with archive.open(one.file) as dataset:
        for source in dict.fromkeys(source for reading in readings for source in reading.sources):
            array, component = source
            plane = () if component is None else (slice(component, component + 1, 1),)
            with dataset.array(one.shown.record, array) as stored:
                taken = stored.read((*plane, rows, columns))
            images[source] = taken.reshape(shape)
    return [reading.of(images) for reading in readings]
