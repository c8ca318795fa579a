"""Enters a reference surface: sealed first, then indexed, or neither; the same surface once."""

from __future__ import annotations

import getpass
import socket
from dataclasses import replace
from datetime import datetime

from sqlalchemy.orm import Session

import sms_jobs
from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive, Provenance, Sealed, layout
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import FileRow, StatisticRow
from sms_jobs.jobs.entering import enter_file, entered_or_discarded
from sms_jobs.kinds.products import REFERENCE_SURFACE
from sms_jobs.records.campaign import Subject
from sms_jobs.records.surfaces import REFERENCE_SURFACES, ReferenceSurface


def register_surface(
    catalogue: Catalogue, archive: Archive, campaign: str, surface: ReferenceSurface, now: datetime
) -> tuple[int, bool]:
    """Make a surface the one that a campaign is compared with from now on.

    Earlier ones stay in the archive, with the results that were made with them.

    Returns
    -------
    Number of the file, and whether it is new: the same surface again is entered once.

    Raises
    ------
    NotFound
        There is no such campaign; nothing is changed.
    """
    with catalogue.reading() as session:
        campaigns.campaign_id(session, campaign)
    with entered_or_discarded(archive) as made:
        sealed, statistics = _seal(archive, campaign, surface, now)
        made.append(sealed)
        with catalogue.writing() as session:
            same = _present(session, campaign, sealed.content_hash)
            if same is None:
                return _index(session, campaign, sealed, statistics, now), True
    archive.discard(sealed.path)
    return same, False


def _present(session: Session, campaign: str, content_hash: str) -> int | None:
    """Return the campaign's present surface, if it is that one."""
    number = campaigns.newest_file(session, REFERENCE_SURFACES, Subject(campaign), DATASET_MEDIA_TYPE)
    if number is None or session.get_one(FileRow, number).content_hash != content_hash:
        return None
    return number


def _seal(
    archive: Archive, campaign: str, surface: ReferenceSurface, now: datetime
) -> tuple[Sealed, dict[str, float]]:
    statistics = {"vertices": float(len(surface.vertices)), "faces": float(len(surface.faces))}
    provenance = Provenance(
        kind=REFERENCE_SURFACES,
        kind_version=1,
        subject=Subject(campaign),
        job_id="",
        attempt=1,
        created_at=now,
        parameters={
            "filename": surface.filename,
            "file_sha256": surface.file_sha256,
            "unit": surface.file_unit,
            "turned_over": surface.turned_over,
        },
        inputs=(),
        program_version=sms_jobs.__version__,
        host=socket.gethostname(),
        operator=getpass.getuser(),
        statistics=statistics,
    )
    while archive.path(layout.dataset_path(provenance)).exists():
        provenance = replace(provenance, attempt=provenance.attempt + 1)
    return archive.seal_dataset({REFERENCE_SURFACE.stored_as: surface}, provenance), statistics


def _index(
    session: Session, campaign: str, sealed: Sealed, statistics: dict[str, float], now: datetime
) -> int:
    number = campaigns.campaign_id(session, campaign)
    file = enter_file(session, sealed, REFERENCE_SURFACES, now, campaign_id=number)
    session.add_all(StatisticRow(file_id=file.id, name=n, value=v) for n, v in statistics.items())
    return file.id
