"""A virtual gauge at a place that somebody points at, read from the stored displacement of one state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sqlalchemy.orm import Session

from sms_jobs.app.fields.field_sources import no_part
from sms_jobs.app.holdings.inputs import inputs_at
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, family, search
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.port_names import AT_REST
from sms_jobs.kinds.products import DISPLACEMENT, REGIONS, SURFACE
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.views import view_of

_MOVED = "correlate"


@dataclass(frozen=True)
class GaugeAt:
    """What a virtual gauge reads at a state.

    Attributes
    ----------
    gauge
        As jobs of the kind gauges take it.
    strain, sigma
        Ratios; None where fewer than twelve pixels lie under the grid.
    sigma_calibration
        What the calibration adds to sigma, a ratio; None where it is not known.
    pixels
        How many do.
    """

    file: int
    state: str
    view: str
    gauge: str
    strain: float | None
    sigma: float | None
    sigma_calibration: float | None
    pixels: int


@use_case(Right.READ)
def gauge_at(services: Services, key: str, gauge: str, *, part: str | None = None) -> GaugeAt:
    """Return what a virtual gauge reads, as a job of the kind gauges would, and keep nothing of it.

    Parameters
    ----------
    key
        A displacement, or what was computed from it.
    gauge
        As 'G1 x=10 y=-20 length=6 width=3 angle=45', in mm in the specimen's frame; of a camera alone in its
        reference image, also in pixels, as x=100px.
    part
        Camera whose displacement is taken, of a result of several.

    Raises
    ------
    NotFound
        There is no such file, or none of its displacements is of that camera.
    InvalidInput
        It was not computed from a displacement, or the gauge cannot be understood or says nothing there.
    ArchiveCorrupt
        A file is not what was sealed.
    """
    # What computes takes a second to load: the server's start, where nobody has asked for a gauge yet.
    from sms_jobs.formats.gauge_descriptions import described_gauge
    from sms_jobs.kinds.calibration_factors import OF_BOTH, states_from
    from sms_jobs.kinds.deformation.gauges import GaugesParameters, frame_of_gauges, read_gauges

    described_gauge(gauge)
    parameters = GaugesParameters(gauge=(gauge,))
    with services.catalogue.reading() as session:
        moved, shape = _displacement(session, search.file_view(session, key), part or "")
        subject = moved.in_campaign()
        campaign = campaigns.definition(campaigns.campaign_row(session, subject.campaign))
    with services.archive.open(moved) as dataset, services.archive.open(shape) as at_rest:
        known = all(product.is_in(dataset) for product in OF_BOTH)
        states = states_from(*(product.read(dataset) for product in OF_BOTH)) if known else None
        found = read_gauges(
            DISPLACEMENT.read(dataset),
            REGIONS.read(dataset),
            SURFACE.read(at_rest),
            states,
            frame_of_gauges(campaign, subject),
            parameters,
            lambda fraction, message="": None,
        )
    strain, sigma = float(found.strain[0]), float(found.sigma[0])
    common = None if found.sigma_calibration is None else float(found.sigma_calibration[0])
    reads = bool(np.isfinite(strain))
    return GaugeAt(
        moved.id,
        subject.state or "",
        subject.view or "",
        gauge,
        strain if reads else None,
        sigma if reads else None,
        common if reads else None,
        int(found.pixels[0]),
    )


def _displacement(session: Session, file: FileView, camera: str) -> tuple[FileView, FileView]:
    """Return the displacement that a file is or was computed from, and the shape that it started from."""
    moved = [file] if file.source == _MOVED else []
    moved += [one.file for one in family.ancestry(session, file).inputs if one.file.source == _MOVED]
    cameras = tuple(dict.fromkeys(view_of(one.in_campaign().view).camera for one in moved))
    if camera and cameras and camera not in cameras:
        raise no_part(str(file.id), camera, cameras)
    for one in moved:
        if camera in ("", view_of(one.in_campaign().view).camera):
            shape = inputs_at(family.ancestry(session, one).inputs, AT_REST)
            if shape:
                return one, shape[0]
    raise InvalidInput(
        f"file {file.id} ({file.source}) was computed from no displacement; choose a displacement, a "
        "strain or a merged result"
    )
