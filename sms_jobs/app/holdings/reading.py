"""Reads what a file of the archive holds, with where it comes from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from typing import Any

from numpy.typing import NDArray
from sqlalchemy.orm import Session

from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE, Provenance
from sms_jobs.archive.codec import class_named, layout_of, record_from_parts
from sms_jobs.archive.dataset import ArchivedDataset
from sms_jobs.archive.provenance import provenance_from_json, provenance_to_json
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, search, subject_files
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, NotFound, OtherFormat
from sms_jobs.jobs.results.turned import is_turned_file
from sms_jobs.kinds import all_kinds
from sms_jobs.records.people import Right
from sms_jobs.records.record_names import RecordName
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.subject import Subject


@dataclass(frozen=True)
class StoredRecord:
    """A record of a file.

    Attributes
    ----------
    file, name
        Which file, and which of its records.
    record
        The record itself. Frames are read as long as the file is open, and so not from here.
    provenance
        How the file came about.
    """

    file: FileView
    name: str
    record: Any
    provenance: Provenance


@dataclass(frozen=True)
class Newest:
    """The newest file that has a record, and the name of that; None for the main one."""

    file: FileView
    record: str | None


@use_case(Right.READ)
def newest(services: Services, subject: str, what: str) -> StoredRecord:
    """Read the newest record of a name, or the main one of a kind, about a subject; as `newest_file` does."""
    found = newest_file(services, subject, what)
    return _read(services, found.file, found.record)


@use_case(Right.READ)
def newest_file(services: Services, subject: str, what: str) -> Newest:
    """Find the newest record of a name, or the main one of a kind, about a subject.

    Parameters
    ----------
    subject
        As campaign/state/view, campaign/state or campaign.
    what
        Name of a kind, such as strain, or else of a record, such as displacement or surface.

    Raises
    ------
    InvalidInput
        It is no subject.
    NotFound
        There is no such campaign or result, or none along the specimen's frame that the campaign has now.
    """
    about = Subject.parse(subject)
    with services.catalogue.reading() as session:
        campaigns.campaign_id(session, about.campaign)
        files, name = _newest_first(session, {what}, about), None
        if not files:
            files, name = _newest_first(session, _with_record(what), about), what
        if not files:
            raise NotFound(
                f"there is no {what} of {subject} in the archive; 'sms data find -c {about.campaign}' shows "
                "what there is"
            )
        number = next((one for one in files if not is_turned_file(session, one)), None)
        if number is None:
            raise NotFound(
                f"each {what} of {subject} is of another frame of the specimen than its campaign has now: "
                f"submit the pipeline again, or read the newest by its number, {files[0]}"
            )
        return Newest(search.file_view(session, str(number)), name)


def _newest_first(session: Session, sources: Iterable[str], about: Subject) -> list[int]:
    """Return the numbers of the files that one of some kinds made about a subject, the newest first."""
    found = (subject_files.files_newest_first(session, one, about, DATASET_MEDIA_TYPE) for one in sources)
    return sorted(chain.from_iterable(found), reverse=True)


def _with_record(name: str) -> set[str]:
    """Return what makes files that have a record of a name, with a key behind it or without."""
    stems = {name, RecordName.parse(name).name}
    return {
        kind.makes or kind.name
        for kind in all_kinds().values()
        if any(product.name in stems for product in kind.records)
    }


@use_case(Right.READ)
def of_file(services: Services, key: str, name: str | None = None) -> StoredRecord:
    """Read a record of the file of that number or archive path; the first if it is not named.

    Raises
    ------
    NotFound
        There is no such file or record.
    InvalidInput
        It is a document.
    ArchiveCorrupt
        The file is not as it was sealed.
    """
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    return _read(services, view, name)


@dataclass(frozen=True)
class RecordParts:
    """A record as it travels, without its arrays.

    Attributes
    ----------
    file, name
        Which file, and which of its records.
    record
        Its class.
    fields, provenance
        What is no array, and how the file came about, as the archive has them: JSON.
    arrays
        Shape, type, unit and meaning of each array, by name.
    """

    file: FileView
    name: str
    record: str
    fields: str
    provenance: str
    arrays: dict[str, Any]


@use_case(Right.READ)
def parts_of_file(services: Services, key: str, name: str | None = None) -> RecordParts:
    """Return a record of a file without its arrays; raises as `of_file` does."""
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    with _opened(services, view, name) as (dataset, found):
        record, plain = dataset.parts_of(found)
        made = provenance_to_json(dataset.provenance)
        return RecordParts(view, found, record, plain, made, dataset.describe()[found])


def assembled(parts: RecordParts, read: Callable[[str], NDArray[Any]]) -> StoredRecord:
    """Return a record that was taken apart.

    Parameters
    ----------
    read
        Returns the array of a name. Frames are not read.

    Raises `OtherFormat` where this version of the program has other records.
    """
    try:
        record = class_named(parts.record, parts.file.path)
        layout = layout_of(record)
        arrays = {
            name: None if layout.arrays[name].streamed else read(name)
            for name in parts.arrays
            if name in layout.arrays
        }
        built: Any = record_from_parts(record, parts.fields, arrays, parts.file.path)
    except (ArchiveCorrupt, TypeError) as error:
        raise OtherFormat(
            f"the {parts.record} of file {parts.file.id} comes from another version of sms_jobs; install the "
            "version of the server"
        ) from error
    return StoredRecord(
        parts.file, parts.name, built, provenance_from_json(parts.provenance, parts.file.path)
    )


@contextmanager
def _opened(services: Services, view: FileView, name: str | None) -> Iterator[tuple[ArchivedDataset, str]]:
    """Open a file, and find out which of its records is meant."""
    if view.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(f"file {view.id} is a {view.media_type} document, which holds no records")
    with services.archive.open(view) as dataset:
        yield dataset, name or (view.source if view.source in dataset.names else dataset.names[0])


def _read(services: Services, view: FileView, name: str | None) -> StoredRecord:
    with _opened(services, view, name) as (dataset, found):
        record: Any = dataset.read(found, dataset.record_class(found))
        return StoredRecord(view, found, record, dataset.provenance)
