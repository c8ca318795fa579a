"""A campaign's specimen frame: found on the reference surface, shown, and taken away again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.app.specimens import campaigns
from sms_jobs.app.specimens.frame_choice import Choice, in_world
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns as campaign_rows
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.people import Right
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.specimen_frame import SpecimenFrame

_FOLLOW = ("strain", "gauges")


@dataclass(frozen=True)
class FrameOf:
    """The specimen frame of a campaign.

    Attributes
    ----------
    frame
        As it was found; None where nobody has.
    of_scene
        Whether, where nobody has, the scene of the virtual rig says where it lies.
    in_image
        Whether there can be none: cameras alone measure in the plane of their images, along whose axes
        results lie.
    stale
        How many results lie along other axes now, by kind.
    """

    campaign: str
    frame: SpecimenFrame | None
    of_scene: bool
    in_image: bool
    stale: dict[str, int]


@use_case(Right.READ)
def show(services: Services, name: str) -> FrameOf:
    """Return the specimen frame of a campaign.

    Raises `NotFound` where there is none of that name, and `InvalidInput` for a calibration session.
    """
    from sms_jobs.jobs.asking.campaign_matrix import matrix

    with services.catalogue.reading() as session:
        row = campaign_rows.campaign_row(session, name)
        campaign = campaign_rows.definition(row)
        _refuse_session(campaign)
        cells = matrix(session, row, datetime.now(UTC))
    stale = [cell.kind for cell in cells if cell.condition == "stale" and cell.kind in _FOLLOW]
    counts = {kind: stale.count(kind) for kind in _FOLLOW if kind in stale}
    in_image = campaign.frame is None and not campaign.shape_views
    of_scene = campaign.frame is None and not in_image and campaign.scene is not None
    return FrameOf(name, campaign.frame, of_scene, in_image, counts)


@use_case(Right.COMPUTE)
def find(services: Services, name: str, choice: Choice) -> FrameOf:
    """Find the specimen frame of a campaign on its measured surface, and keep it from now on.

    Strain and virtual gauges that lie along other axes are stale from then on; nothing else is.

    Raises
    ------
    NotFound
        There is no such campaign, or the reference surface of the view has not been computed.
    InvalidInput
        The points or the region tell no frame, it is a calibration session, or no view measures shape.
    Conflict
        The campaign is changed by somebody else just now.
    """
    # Arrays and kernels, which nobody who only looks at campaigns should wait for.
    from sms_jobs.app.specimens import frame_finding

    before = _test(services, name)
    if not before.shape_views:
        raise InvalidInput(
            f"campaign {name} has no shape on which a frame could be found: by {', '.join(before.views)} it "
            "measures in the plane of the image, along whose axes its results lie"
        )
    if in_world(choice):
        frame = frame_finding.through_world_points(choice)
    else:
        frame = _on_surface(services, before, choice)
    _amend(services, before, replace(before, frame=frame))
    return show(services, name)


@use_case(Right.COMPUTE)
def drop(services: Services, name: str) -> FrameOf:
    """Take the frame of a campaign away, so that the specimen's axes are the scene's or the world's again.

    Raises
    ------
    NotFound
        There is no such campaign, or it has no frame.
    Conflict
        It is changed by somebody else just now.
    """
    before = _test(services, name)
    if before.frame is None:
        raise NotFound(f"campaign {name} has no specimen frame that could be taken away")
    _amend(services, before, replace(before, frame=None))
    return show(services, name)


def _test(services: Services, name: str) -> Campaign:
    campaign = campaigns.definition(services, name)
    _refuse_session(campaign)
    return campaign


def _refuse_session(campaign: Campaign) -> None:
    if campaign.session is not None:
        raise InvalidInput(f"{campaign.name} is a calibration session, which has no specimen; choose a test")


def _amend(services: Services, before: Campaign, after: Campaign) -> None:
    from sms_jobs.jobs.archiving.importing import amend_campaign

    if after != before:
        amend_campaign(services.catalogue, services.archive, before, after, datetime.now(UTC))


def _on_surface(services: Services, campaign: Campaign, choice: Choice) -> SpecimenFrame:
    """Find a frame by pixels of a view's reference image, or by the plane of a region."""
    from sms_jobs.app.holdings import reading
    from sms_jobs.app.specimens.frame_finding import Finder
    from sms_jobs.kinds.calibration_factors import known_view
    from sms_jobs.kinds.products import CALIBRATION_FACTOR, SURFACE

    view = choice.view or campaign.shape_views[0]
    if view not in campaign.shape_views:
        raise InvalidInput(
            f"a frame is found on a measured shape, which campaign {campaign.name} has by "
            f"{', '.join(campaign.shape_views)}, not by {view}; choose a view that measures shape"
        )
    about = Subject(campaign.name, campaign.reference.label, view)
    found = reading.newest_file(services, str(about), SURFACE.name).file
    with services.archive.open(found) as dataset:
        surface = SURFACE.read(dataset)
        factor = CALIBRATION_FACTOR.read_if_there(dataset)
    known_by = known_view(factor) if factor and factor.is_stated else None
    image = _texture(services, about) if choice.markers else None
    return Finder(surface, known_by, image, choice).frame(found.content_hash)


def _texture(services: Services, about: Subject) -> NDArray[np.generic]:
    """Return the image of the reference state that marks are looked for in."""
    from sms_jobs.app.holdings import reading
    from sms_jobs.kinds.products import MEASURED
    from sms_jobs.kinds.surface_ports import textured_by

    recorded = reading.newest_file(services, str(textured_by(about)), MEASURED.name).file
    with services.archive.open(recorded) as dataset:
        return MEASURED.read(dataset).texture
