"""What a gauge sees of the errors of a displacement and of the surface that it is on."""

from __future__ import annotations

from typing import cast

import numpy as np

from sms_jobs.kinds.surface_ports import bias_in_space, independent_covariance, position_covariance
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.deformation.strain.strain_errors import (
    MatchedShape,
    SharedErrors,
    Window,
    shared_errors,
)
from sms_jobs.metrology.geometry.planes import covariance_in_space
from sms_jobs.records.fields import DisplacementField, Surface


def _radius_in_time(moved: DisplacementField) -> int:
    """Return the radius in px of the subsets that were matched in time."""
    return moved.subset_radius_px if moved.match_radius_px is None else moved.match_radius_px


def errors_of_gauge(
    moved: DisplacementField, surface: Surface, disc_radius_px: float, window: Window | None = None
) -> SharedErrors:
    """Return the errors of a displacement and of its reference surface as they disturb strain over a gauge.

    `disc_radius_px` and `window` are those of `shared_errors`.
    """
    shape = None
    if surface.subset_radius_px and surface.shape_order is not None:
        subsets = Subsets(surface.subset_radius_px, cast(ShapeOrder, surface.shape_order))
        shape = MatchedShape(position_covariance(surface), subsets)
    return shared_errors(
        covariance_in_space(moved.covariance),
        independent_covariance(surface),
        bias_in_space(moved),
        averaging_radius_px=moved.averaging_radius_px,
        subset_radius_px=_radius_in_time(moved),
        order=cast(ShapeOrder, 1 if moved.match_order is None else moved.match_order),
        disc_radius_px=disc_radius_px,
        match_margin_px=moved.match_margin_px or 0,
        shape=shape,
        window=window,
    )


def errors_of_rectangle(
    moved: DisplacementField, surface: Surface, length_px: float, width_px: float
) -> SharedErrors:
    """Return the errors of a displacement as they disturb slopes along the length of a rectangle."""
    window = Window.nearest(length_px, width_px)
    return errors_of_gauge(moved, surface, float(np.sqrt(length_px * width_px / np.pi)), window)
