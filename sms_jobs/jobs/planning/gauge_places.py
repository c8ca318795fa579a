"""Whether the gauges of planned jobs lie in the images and on the surfaces that they are read from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive
from sms_jobs.catalogue import search
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.subject_files import newest_file
from sms_jobs.errors import InvalidInput, SmsError
from sms_jobs.jobs.planning.graph import PlannedJob
from sms_jobs.jobs.planning.image_regions import recorded_shape
from sms_jobs.kinds.port_names import AT_REST
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sms_jobs.kinds.gauges_in_images import Sight
    from sms_jobs.kinds.products import Product
    from sms_jobs.records.campaign import Campaign

R = TypeVar("R")

_READS, _LOOK, _STRAIN = "gauges", "quick-look", "strain"
IN_PIXELS = "gauge_length_px"
"""Of strain, which cameras alone take."""
KINDS = (_READS, _LOOK)
"""Those that read gauges."""


def check_gauges(session: Session, archive: Archive, campaign: str, jobs: Sequence[PlannedJob]) -> None:
    """Refuse jobs one of whose gauges no view can read, by the images and surfaces that are there.

    Of quick looks, which show more than gauges, those of which no gauge can be read; of strain, a gauge
    length in pixels that no view takes. Raises `InvalidInput`.
    """
    _refuse_pixels(session, campaign, jobs)
    reading = {job.subject.view or "": job for job in jobs if job.kind.name == _READS}
    looking = {job.subject.view or "": job for job in jobs if job.kind.name == _LOOK and _at_rest(job)}
    if not reading and not looking:
        return
    # It needs what computes, which few plans do.
    from sms_jobs.kinds import gauges_in_images

    defined = definition(campaign_row(session, campaign))
    if reading:
        sights = {view: _of_job(session, archive, defined, jobs, job) for view, job in reading.items()}
        for job in reading.values():
            gauges_in_images.check_gauges(job.parameters.model_dump()["gauge"], sights, defined.views)
    if looking:
        sights = {view: _of_job(session, archive, defined, jobs, job) for view, job in looking.items()}
        lost = gauges_in_images.declared_unread(defined, sights)
        if lost and all(lost.values()):
            raise InvalidInput(f"{next(iter(lost.values()))}; or set `alone` to look at the shape alone")


def _refuse_pixels(session: Session, campaign: str, jobs: Sequence[PlannedJob]) -> None:
    """Refuse a gauge length of strain in pixels where all views measure surfaces, which take theirs in mm."""
    strain = next((job for job in jobs if job.kind.name == _STRAIN), None)
    given = {} if strain is None else strain.parameters.model_dump()
    if given.get(IN_PIXELS) is None or given["gauge_length_mm"] is not None:
        return
    views = definition(campaign_row(session, campaign)).views
    if all(view_of(view).measures_shape for view in views):
        raise InvalidInput(
            f"{IN_PIXELS} is {given[IN_PIXELS]:g}, which cameras alone take, and {campaign} has none "
            f"beside {', '.join(views)}: give gauge_length_mm"
        )


def check_looked_at(
    session: Session, archive: Archive, campaign: Campaign, views: Sequence[str], gauges: Sequence[str]
) -> None:
    """Refuse gauges by name that no quick look at some views can read; `InvalidInput`."""
    from sms_jobs.kinds import gauges_in_images
    from sms_jobs.kinds.shape.sparse_plane import scale_of
    from sms_jobs.kinds.surface_ports import surface_port

    sights: dict[str, Sight] = {}
    for view in views:
        at_rest = Subject(campaign.name, campaign.reference.label, view)
        for source in (_LOOK, surface_port(AT_REST).of(campaign, at_rest).source):
            seen = _sight(session, archive, campaign, source, at_rest, scale_of(campaign))
            sights[view] = sights.get(view) or seen
    lost = gauges_in_images.declared_unread(campaign, sights)
    for name in gauges:
        if why := lost.get(name):
            raise InvalidInput(why)


def _at_rest(job: PlannedJob) -> bool:
    return any(given.need.port.name == AT_REST for given in job.inputs)


def _of_job(
    session: Session, archive: Archive, campaign: Campaign, jobs: Sequence[PlannedJob], job: PlannedJob
) -> Sight:
    """Return where gauges of a job can be; None where nobody knows."""
    from sms_jobs.kinds.shape.sparse_plane import scale_of

    (given,) = (given for given in job.inputs if given.need.port.name == AT_REST)
    maker = None if given.producer is None else jobs[given.producer]
    comes = maker is not None or given.existing is None or given.existing.job_id is not None
    source = "" if comes else given.need.source
    own = {} if maker is None else maker.parameters.model_dump()
    scale, made = own.get("mm_per_px", scale_of(campaign)), "mm_per_px" in own
    return _sight(session, archive, campaign, source, given.need.subject, scale, made=made)


def _sight(
    session: Session,
    archive: Archive,
    campaign: Campaign,
    source: str,
    at_rest: Subject,
    mm_per_px: float | None,
    *,
    made: bool = False,
) -> Sight:
    """Return where gauges of a view can be, by its surface of a kind, or by the image of a camera alone.

    `source` is empty where the surface has yet to be made; `made` where it is about to be, with that scale.
    """
    from sms_jobs.kinds.gauges_in_images import ImageAlone, surface_there
    from sms_jobs.kinds.products import SURFACE

    view = at_rest.view or ""
    surface = _read(session, archive, source, at_rest, SURFACE) if source else None
    if view_of(view).measures_shape:
        return None if surface is None else surface_there(campaign, surface, sparse=source == _LOOK)
    if surface is not None and source != _LOOK:
        rows, columns = surface.reason.shape
        return ImageAlone(view, columns, rows, surface.mm_per_px, made=True)
    shape = recorded_shape(session, archive, at_rest)
    if shape is None:
        return None
    rows, columns = shape
    return ImageAlone(view, columns, rows, mm_per_px, made)


def _read(session: Session, archive: Archive, source: str, subject: Subject, product: Product[R]) -> R | None:
    """Read a record of the newest file of a subject; None where there is none, or it cannot be read now."""
    file_id = newest_file(session, source, subject, DATASET_MEDIA_TYPE)
    if file_id is None:
        return None
    try:
        with archive.open(search.file_view(session, str(file_id))) as dataset:
            return product.read(dataset)
    except SmsError:
        # Jobs can be queued while the archive is away; the job itself tells what is wrong with its input.
        return None
