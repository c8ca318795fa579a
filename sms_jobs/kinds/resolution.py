"""Spatial resolution of what comes of matches: in the image, on the surface, and as numbers to find it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.deformation.fields.spatial_resolution import (
    left_by_averaging,
    left_by_blending,
    periods_about,
    pixel_extent,
    resolution_of,
    response_of_subsets,
)
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.records.fields import DisplacementField, StrainField, Surface


def resolution_of_matches(
    radius: int, order: ShapeOrder, numbers: int, spacing: int, averaging_radius: float = 0.0
) -> float:
    """Return the spatial resolution in px of what is spread from matches.

    `radius` and `order` are those of the subsets, `numbers` those of a warp, `spacing` that of the points,
    `averaging_radius` that of the mean afterwards, 0 for none; lengths in px.
    """
    periods = periods_about(radius)
    left = left_by_blending(response_of_subsets(radius, order, periods), radius, numbers, spacing)
    return resolution_of(periods, left * left_by_averaging(averaging_radius, periods))


def extent_of_pixels(surface: Surface, labels: NDArray[np.int32], radius_px: int) -> NDArray[np.float64]:
    """Return what each pixel (rows, columns) covers of a surface where that is most, in the surface's unit.

    As means over squares of some radius; in the plane of an image it is the size of a pixel.
    """
    if surface.has_depth:
        return pixel_extent(surface.position, labels, radius_px)
    return np.full(labels.shape, 1.0 if surface.mm_per_px is None else surface.mm_per_px)


def resolution_statistics(field: DisplacementField | StrainField) -> dict[str, float]:
    """Return the median resolution in px and in the field's unit; nothing where it is not known."""
    if field.resolution is None or field.resolution_px is None or np.isnan(field.resolution).all():
        return {}
    return {
        f"median_resolution_{field.unit}": float(np.nanmedian(field.resolution)),
        "median_resolution_px": field.resolution_px,
    }
