"""Whether the gauges of planned jobs lie in the images that they are read from, before any is queued."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue import search
from sms_jobs.errors import SmsError
from sms_jobs.jobs.planning.graph import PlannedInput, PlannedJob
from sms_jobs.jobs.planning.submission import Draft
from sms_jobs.kinds.port_names import AT_REST
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sms_jobs.kinds.gauges_in_images import ImageAlone
    from sms_jobs.kinds.products import Product

R = TypeVar("R")


def check_gauges(session: Session, archive: Archive, planned: Draft) -> None:
    """Refuse a plan one of whose gauges no view can read, by the images that are there; `InvalidInput`."""
    by_view = {job.subject.view or "": job for job in planned.jobs if job.kind.name == "gauges"}
    if by_view:
        # It needs what computes, which few plans do.
        from sms_jobs.kinds import gauges_in_images

        images = {view: _image(session, archive, planned, job) for view, job in by_view.items()}
        for job in by_view.values():
            gauges_in_images.check_gauges(job.parameters.model_dump()["gauge"], images)


def _image(session: Session, archive: Archive, planned: Draft, job: PlannedJob) -> ImageAlone | None:
    """Return the image that gauges of a view are placed in; None on a surface, or where nobody knows it."""
    from sms_jobs.kinds.gauges_in_images import ImageAlone
    from sms_jobs.kinds.products import MEASURED, SURFACE

    view = job.subject.view or ""
    if view_of(view).measures_shape:
        return None
    (shape,) = (given for given in job.inputs if given.need.port.name == AT_REST)
    if shape.producer is None:
        surface = _read(session, archive, shape, SURFACE)
        if surface is None:
            return None
        rows, columns = surface.reason.shape
        return ImageAlone(view, columns, rows, surface.mm_per_px)
    maker = planned.jobs[shape.producer]
    measured = _read(session, archive, maker.inputs[0], MEASURED)
    if measured is None:
        return None
    rows, columns = measured.texture.shape
    return ImageAlone(view, columns, rows, maker.parameters.model_dump()["mm_per_px"])


def _read(session: Session, archive: Archive, given: PlannedInput, product: Product[R]) -> R | None:
    """Read a record of an input; None where a job has yet to make it, or it cannot be read now."""
    if given.existing is None or given.existing.file_id is None:
        return None
    try:
        with archive.open(search.file_view(session, str(given.existing.file_id))) as dataset:
            return product.read(dataset)
    except SmsError:
        # Jobs can be queued while the archive is away; the job itself tells what is wrong with its input.
        return None
