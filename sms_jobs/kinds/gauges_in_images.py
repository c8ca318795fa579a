"""Whether gauges lie in the images of cameras alone, where the size of these is known beforehand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import hypot
from typing import Any

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import DescribedGauge, described_gauge
from sms_jobs.kinds.deformation.gauges import KIND
from sms_jobs.kinds.shape.sparse_plane import scale_of
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.sensors import Rig
from sms_jobs.records.views import view_of


@dataclass(frozen=True)
class ImageAlone:
    """The image of a camera alone, in pixels; `mm_per_px` is None where a pixel has no size."""

    view: str
    columns: int
    rows: int
    mm_per_px: float | None = None


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
        check_gauges(KIND.checked_parameters(given).gauge, images)


def check_gauges(gauges: Iterable[str], images: Mapping[str, ImageAlone | None]) -> None:
    """Refuse a gauge that lies outside of the images of all views that might read it.

    Parameters
    ----------
    gauges
        As they are described.
    images
        By view; None for one that measures shape, or whose size is not known.

    Raises
    ------
    InvalidInput
        With the gauge's place, and the image's.
    """
    for gauge in map(described_gauge, gauges):
        read_by = [images[view] for view in images if gauge.unit == "mm" or not view_of(view).measures_shape]
        missed = [_missed(gauge, image) for image in read_by]
        if missed and all(missed):
            raise InvalidInput(str(missed[0]))


def _missed(gauge: DescribedGauge, image: ImageAlone | None) -> str | None:
    """Say how a gauge lies outside of an image; None where it does not, or nobody knows."""
    if image is None or (gauge.unit == "mm" and image.mm_per_px is None):
        return None
    size = 1.0 if gauge.unit == "px" or image.mm_per_px is None else image.mm_per_px
    right, bottom = size * (image.columns - 1), size * (image.rows - 1)
    place = gauge.place
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
