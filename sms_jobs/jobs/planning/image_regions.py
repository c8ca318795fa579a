"""Whether the regions that planned jobs are to look at have a pixel of their images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive
from sms_jobs.catalogue import search
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.subject_files import newest_file
from sms_jobs.errors import SmsError
from sms_jobs.jobs.planning.graph import PlannedJob
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

REGIONS = {"correlate": "region_of_interest", "relative": "region"}
"""Parameters that say which part of the reference image counts, by kind."""


def check_regions(session: Session, archive: Archive, campaign: str, jobs: Sequence[PlannedJob]) -> None:
    """Refuse jobs with a region that leaves no pixel of the image that it is chosen in; `InvalidInput`.

    The size of an image is that of the recorded reference state or, before, of the virtual rig's camera.
    """
    chosen: dict[tuple[str, str], PlannedJob] = {}
    for job in jobs:
        if job.subject.view is not None and _region(job):
            chosen.setdefault((_region(job), job.subject.view), job)
    if not chosen:
        return
    # It needs what computes, which few plans do.
    from sms_jobs.kinds.deformation.textured_state import pixels_of_interest

    defined = definition(campaign_row(session, campaign))
    for (region, view), job in chosen.items():
        shape = _shape_of_image(session, archive, defined, view)
        if shape is not None:
            pixels_of_interest(region, shape, job.subject)


def _region(job: PlannedJob) -> str:
    name = REGIONS.get(job.kind.name)
    return "" if name is None else str(getattr(job.parameters, name))


def _shape_of_image(
    session: Session, archive: Archive, campaign: Campaign, view: str
) -> tuple[int, int] | None:
    """Return rows and columns of the reference image of a view; None where nobody knows."""
    (at_rest, *_) = Subject(campaign.name, campaign.reference.label, view).recordings
    if newest_file(session, MEASUREMENT, at_rest, DATASET_MEDIA_TYPE) is not None:
        return recorded_shape(session, archive, at_rest)
    if campaign.scene is None:
        return None
    camera = campaign.scene.rig.sensor(view_of(view).camera)
    return camera.rows, camera.columns


def recorded_shape(session: Session, archive: Archive, recording: Subject) -> tuple[int, int] | None:
    """Return rows and columns of a recorded image; None where there is none, or it cannot be read now."""
    from sms_jobs.kinds.products import MEASURED

    file_id = newest_file(session, MEASUREMENT, recording, DATASET_MEDIA_TYPE)
    if file_id is None:
        return None
    try:
        with archive.open(search.file_view(session, str(file_id))) as dataset:
            rows, columns = dataset.describe()[MEASURED.stored_as]["texture"]["shape"]
    except SmsError:
        # Jobs can be queued while the archive is away; the job itself tells what is wrong with its input.
        return None
    return rows, columns
