"""Enters a reference surface; the same surface once."""

from __future__ import annotations

from datetime import datetime

from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.archiving.repository import Repository, brought_in
from sms_jobs.kinds.kind import REFERENCE_SURFACES
from sms_jobs.kinds.products import REFERENCE_SURFACE
from sms_jobs.records.subject import Subject
from sms_jobs.records.surfaces import ReferenceSurface


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
    provenance = brought_in(
        REFERENCE_SURFACES,
        Subject(campaign),
        now,
        parameters={
            "filename": surface.filename,
            "file_sha256": surface.file_sha256,
            "unit": surface.file_unit,
            "turned_over": surface.turned_over,
        },
        statistics={"vertices": float(len(surface.vertices)), "faces": float(len(surface.faces))},
    )
    kept = Repository(catalogue, archive).put({REFERENCE_SURFACE.stored_as: surface}, provenance)
    return kept.file_id, kept.new
