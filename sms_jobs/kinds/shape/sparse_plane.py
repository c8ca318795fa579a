"""The image of a camera alone as a surface at some pixels only; its specimen is what has texture."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.shape.plane import KIND as PLANE
from sms_jobs.kinds.shape.plane import PlaneParameters, plane_of
from sms_jobs.kinds.shape.sparse_surface import first_px
from sms_jobs.metrology.deformation.strain.gauge_points import SparseSurface
from sms_jobs.metrology.geometry.planes import in_space
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason


def scale_of(campaign: Campaign) -> float | None:
    """Return the size of a pixel on the specimen in mm, by the campaign's own parameters; None without."""
    return PlaneParameters.model_validate(campaign.processing.get(PLANE.name, {})).mm_per_px


def sparse_plane(view: str, measurement: Measurement, parameters: PlaneParameters, step: int) -> Surface:
    """Return every `step`-th pixel of the plane, in mm; raise `InvalidInput` where a pixel has no size."""
    if parameters.mm_per_px is None:
        raise InvalidInput(
            f"the image of {view} has no scale, so gauges in mm mean nothing there: give the size of a pixel "
            "as mm_per_px under [processing.plane] of the test plan"
        )
    whole = plane_of(measurement, view, parameters)
    chosen = slice(first_px(step), None, step)
    return Surface(
        whole.view,
        whole.unit,
        np.ascontiguousarray(whole.position[:, chosen, chosen]),
        np.ascontiguousarray(whole.reason[chosen, chosen]),
        mm_per_px=whole.mm_per_px,
    )


def plane_with_regions(surface: Surface, step: int) -> SparseSurface:
    """Return a sparse plane with its regions, parted by what has no texture; a pixel's place is exact."""
    labels, _ = ndimage.label(surface.reason == Reason.VALID, np.ones((3, 3)))
    position = in_space(surface.position)
    covariance = np.zeros((6, *labels.shape), np.float32)
    return SparseSurface(position, covariance, labels.astype(np.int32), step, first_px(step))
