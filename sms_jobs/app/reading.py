"""Reads what a file of the archive holds, with where it comes from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE, Provenance
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, search
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.kinds import all_kinds
from sms_jobs.records.campaign import Subject
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView


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


@use_case(Right.READ)
def newest(services: Services, subject: str, what: str) -> StoredRecord:
    """Read the newest record of a name, or the main one of a kind, about a subject.

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
        There is no such campaign or result.
    ArchiveCorrupt
        The file is not as it was sealed.
    """
    about = Subject.parse(subject)
    with services.catalogue.reading() as session:
        campaigns.campaign_id(session, about.campaign)
        number, name = _newest(session, {what}, about), None
        if number is None:
            number, name = _newest(session, _with_record(what), about), what
        if number is None:
            raise NotFound(
                f"there is no {what} of {subject} in the archive; 'sms data find -c {about.campaign}' shows "
                "what there is"
            )
        view = search.file_view(session, str(number))
    return _read(services, view, name)


def _newest(session: Session, sources: Iterable[str], about: Subject) -> int | None:
    """Return the number of the newest file that one of some kinds made about a subject."""
    found = (campaigns.newest_file(session, source, about, DATASET_MEDIA_TYPE) for source in sources)
    return max((number for number in found if number is not None), default=None)


def _with_record(name: str) -> set[str]:
    """Return what makes files that have a record of a name, with a key behind it or without."""
    stems = {name, name.partition("_")[0]}
    return {
        kind.makes or kind.name
        for kind in all_kinds().values()
        if any(product.name in stems for product in kind.outputs)
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


def _read(services: Services, view: FileView, name: str | None) -> StoredRecord:
    if view.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(f"file {view.id} is a {view.media_type} document, which holds no records")
    with services.archive.open(view) as dataset:
        found = name or (view.source if view.source in dataset.names else dataset.names[0])
        record: Any = dataset.read(found, dataset.record_class(found))
        return StoredRecord(view, found, record, dataset.provenance)
