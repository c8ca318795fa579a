"""Whether gauges lie in the images or on the surfaces that they are read from, where these are known."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from math import hypot
from typing import Any, TypeAlias

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import DescribedGauge, described_gauge
from sms_jobs.kinds.deformation.gauges import KIND, across, frame_of_gauges, read_by, refuse_longer
from sms_jobs.kinds.shape.sparse_plane import scale_of
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.strain.gauges import LEAST_PIXELS
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Rig
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of


@dataclass(frozen=True)
class ImageAlone:
    """The image of a camera alone, in pixels; `mm_per_px` is None where a pixel has no size.

    Until its plane is `made`, or is about to be, a pixel may still be given one.
    """

    view: str
    columns: int
    rows: int
    mm_per_px: float | None = None
    made: bool = False


@dataclass(frozen=True)
class SurfaceThere:
    """The surface of a view at rest: the places x and y of its points in the gauges' frame, in mm.

    `across` is its diagonal. `spacing` is how far its points are apart where it has some pixels only, as that
    of a quick look; 0 where it has all of them.
    """

    view: str
    x: Floats
    y: Floats
    across: float
    spacing: float = 0.0


Sight: TypeAlias = ImageAlone | SurfaceThere | None
"""What a view sees of where gauges can be; None where nobody knows."""


def surface_there(campaign: Campaign, surface: Surface, *, sparse: bool) -> Sight:
    """Return where a surface of several sensors lies; None where it has no valid point."""
    frame = frame_of_gauges(campaign, Subject(campaign.name, view=surface.view))
    away = np.asarray(surface.position) - np.array(frame.translation)[:, None, None]
    x, y = np.einsum("ij,jrc->irc", frame.matrix().T[:2], away)
    spacing = 0.0
    if sparse:
        steps = (np.hypot(np.diff(x, axis=axis), np.diff(y, axis=axis)) for axis in (0, 1))
        spacing = max((float(np.nanmedian(one)) for one in steps if np.isfinite(one).any()), default=0.0)
    valid = (surface.reason == Reason.VALID) & np.isfinite(x) & np.isfinite(y)
    if not valid.any():
        return None
    return SurfaceThere(surface.view, x[valid], y[valid], across(surface), spacing)


def check_declared(campaign: Campaign, rig: Rig | None) -> None:
    """Refuse a gauge that a campaign declares and none of its views can read, by the sensors of its rig."""
    given: Mapping[str, Any] = campaign.processing.get(KIND.name, {})
    if given and rig is not None:
        sizes = {sensor.name: (sensor.columns, sensor.rows) for sensor in rig.sensors}
        scale = scale_of(campaign)
        images = {
            view: ImageAlone(view, *sizes[view], scale) if view in sizes else None
            for view in campaign.measured_views
        }
        # One in pixels that no view reads yet may be that of a camera that is added later.
        for why in declared_unread(campaign, images).values():
            if why is not None:
                raise InvalidInput(why)


def check_gauges(gauges: Iterable[str], sights: Mapping[str, Sight], views: Collection[str] = ()) -> None:
    """Refuse a gauge that none of the views that might read it can read.

    Parameters
    ----------
    gauges
        As they are described.
    sights
        By view that is to read them.
    views
        All of the campaign; those that are to read them if not given.

    Raises
    ------
    InvalidInput
        With the gauge's place, and where the image or the surface is.
    """
    views = views or tuple(sights)
    for gauge in map(described_gauge, gauges):
        if gauge.unit == "px" and all(view_of(view).measures_shape for view in views):
            raise InvalidInput(
                f"gauge {gauge.name} is in pixels, which only cameras alone read, and there is none beside "
                f"{', '.join(views)}: give its place and its length in mm, in the specimen's frame"
            )
        why = unread(gauge, sights)
        if why is not None:
            raise InvalidInput(why)


def declared_unread(campaign: Campaign, sights: Mapping[str, Sight]) -> dict[str, str | None]:
    """Return the declared gauges that quick looks by some views try to read, and why none of them can."""
    given: Mapping[str, Any] = campaign.processing.get(KIND.name, {})
    declared = KIND.checked_parameters(given).gauge if given.get("gauge") else ()
    gauges = dict.fromkeys(text for view in sights for text in read_by(view, declared))
    return {gauge.name: unread(gauge, sights) for gauge in map(described_gauge, gauges)}


def unread(gauge: DescribedGauge, sights: Mapping[str, Sight]) -> str | None:
    """Say why none of the views can read a gauge; None where one can, or nobody knows."""
    read_by = [sights[view] for view in sights if gauge.unit == "mm" or not view_of(view).measures_shape]
    missed = [None if one is None else _missed(gauge, one) for one in read_by]
    return missed[0] if missed and all(missed) else None


def _missed(gauge: DescribedGauge, sight: ImageAlone | SurfaceThere) -> str | None:
    """Say why a view cannot read a gauge; None where it can, or nobody knows."""
    try:
        return _off(gauge, sight) if isinstance(sight, SurfaceThere) else _outside(gauge, sight)
    except InvalidInput as error:
        return str(error)


def _off(gauge: DescribedGauge, surface: SurfaceThere) -> str | None:
    """Say how a gauge lies off a surface; `InvalidInput` where it is larger."""
    place, x, y = gauge.place, surface.x, surface.y
    refuse_longer(gauge.name, place, f"the surface of {surface.view}", surface.across, gauge.unit)
    far = np.hypot(x - place.x, y - place.y)
    # A gauge reads its own pixels; a quick look fits what is about its ends and its middle.
    reach = place.half_diagonal + 2.0 * surface.spacing if surface.spacing else place.reach
    if far.min() > reach:
        return (
            f"gauge {gauge.name} lies off the surface of {surface.view}: from its middle at x={place.x:g} "
            f"y={place.y:g} mm the nearest point is {far.min():.3g} mm away, and one of its size looks "
            f"{reach:.3g} mm far; the surface reaches from {x.min():.4g} to {x.max():.4g} mm in x and from "
            f"{y.min():.4g} to {y.max():.4g} mm in y; move the gauge onto it, or make it larger"
        )
    count = np.count_nonzero(far <= reach + place.half_diagonal)
    if not surface.spacing and count < LEAST_PIXELS:
        return (
            f"gauge {gauge.name} of {place.length:g} x {place.width:g} mm has at most {count} pixels of the "
            f"surface of {surface.view} under it, and {LEAST_PIXELS} are needed; make it larger"
        )
    return None


def _outside(gauge: DescribedGauge, image: ImageAlone) -> str | None:
    """Say how a gauge lies outside of an image; None where nobody knows; `InvalidInput` if larger."""
    if gauge.unit == "mm" and image.mm_per_px is None:
        unscaled = (
            f"gauge {gauge.name} is in mm, which mean nothing in the image of {image.view}: it has no scale; "
            "write px behind its lengths, or make the plane anew with the size of a pixel as mm_per_px"
        )
        return unscaled if image.made else None
    size = 1.0 if gauge.unit == "px" or image.mm_per_px is None else image.mm_per_px
    right, bottom = size * (image.columns - 1), size * (image.rows - 1)
    place = gauge.place
    refuse_longer(gauge.name, place, f"the image of {image.view}", hypot(right, bottom), gauge.unit)
    if hypot(_beyond(place.x, right), _beyond(place.y, bottom)) <= place.reach:
        return None
    key, value, most = ("x", place.x, right) if _beyond(place.x, right) else ("y", place.y, bottom)
    return (
        f"gauge {gauge.name} lies outside of the image of {image.view}: its {key} is {value:g} "
        f"{gauge.unit}, and the image of {image.columns} x {image.rows} px reaches from 0 to {most:g} "
        f"{gauge.unit}; move it into the image"
    )


def _beyond(value: float, most: float) -> float:
    """Return how far a coordinate lies outside of an image that reaches from 0 to `most`."""
    return max(-value, value - most, 0.0)
