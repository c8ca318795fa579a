"""What a file of the archive holds, shows, and comes from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import family, search
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.keeping import retention
from sms_jobs.jobs.keeping.retention import Pin
from sms_jobs.kinds.port_names import FRAMES_AT_REST
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import Ancestor, FileView


@dataclass(frozen=True)
class Description:
    """What is known of a file.

    Attributes
    ----------
    file, path
        The file, and where it lies.
    statistics
        Numbers that it can be found by.
    readings
        What scalar channels read while it, or what it shows, was recorded.
    records
        Shape, unit and meaning of each array, by record and name; nothing of a document.
    """

    file: FileView
    path: str
    statistics: dict[str, float]
    readings: dict[str, float]
    records: dict[str, Any]


@use_case(Right.READ)
def describe(services: Services, key: str) -> Description:
    """Return what is known of the file of that number or archive path.

    Raises
    ------
    NotFound
        There is no such file.
    ArchiveCorrupt
        It is not as it was sealed.
    """
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
        numbers = search.statistics(session, view.id)
        readings = search.readings(session, view.id)
    records: dict[str, Any] = {}
    if view.media_type == DATASET_MEDIA_TYPE:
        with services.archive.open(view) as dataset:
            records = dataset.describe()
    else:
        services.archive.verify_bytes(view)
    return Description(view, services.archive.location(view.path), numbers, readings, records)


MOST_RELATED = family.MOST


@dataclass(frozen=True)
class Tree:
    """A file and the tree of what it comes from, or of what comes from it; `more` where it ends too early."""

    file: FileView
    inputs: tuple[Ancestor, ...]
    more: bool


@use_case(Right.READ)
def tree(services: Services, key: str, *, down: bool = False) -> Tree:
    """Return what a file was computed from, back to what was measured; or all that was computed from it.

    Raises `NotFound` where there is no such file.
    """
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
        related = family.descent(session, view) if down else family.ancestry(session, view)
    return Tree(view, related.inputs, related.more)


@use_case(Right.READ)
def picture(
    services: Services,
    key: str,
    *,
    record: str | None = None,
    field: str | None = None,
    component: str | None = None,
) -> bytes:
    """Return an image field with colour bar and unit as PNG; of a camera alone, over its reference image.

    Parameters
    ----------
    record, field
        The first record, and its first image, if they are None.
    component
        Such as Z or xx; the magnitude of a vector if it is None.

    Raises
    ------
    NotFound
        There is no such file or record.
    InvalidInput
        It holds no such image.
    """
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
        inputs = family.ancestry(session, view).inputs
    if view.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(f"file {key} is a {view.media_type} document, which cannot be plotted")
    with services.archive.open(view) as dataset:
        name = record or dataset.names[0]
        read: Any = dataset.read(name, dataset.record_class(name))
    behind = None
    if view.in_plane:
        behind = _reference_image(services, inputs)
    from sms_jobs.formats.figures import plot_record

    return plot_record(read, field, component, behind=behind)


def _reference_image(services: Services, inputs: Iterable[Ancestor]) -> Any:
    """Return the texture that a result in an image started from; None where it is not in the archive."""
    from sms_jobs.kinds.products import MEASURED

    for one in inputs:
        if one.port == FRAMES_AT_REST:
            with services.archive.open(one.file) as dataset:
                return MEASURED.read(dataset).texture
        found = _reference_image(services, one.inputs)
        if found is not None:
            return found
    return None


@use_case(Right.COMPUTE)
def pin(services: Services, key: str, reason: str) -> FileView:
    """Keep a file, and all that it was computed from, whatever a policy says; return it."""
    with services.catalogue.writing() as session:
        view = search.file_view(session, key)
        retention.pin(session, view.id, reason, datetime.now(UTC))
    return view


@use_case(Right.COMPUTE)
def unpin(services: Services, key: str) -> FileView:
    """Let a policy decide about a file again; return it."""
    with services.catalogue.writing() as session:
        view = search.file_view(session, key)
        retention.unpin(session, view.id)
    return view


@use_case(Right.READ)
def pins(services: Services) -> list[Pin]:
    """Return the files that are pinned, and why."""
    with services.catalogue.reading() as session:
        return retention.pins(session)
