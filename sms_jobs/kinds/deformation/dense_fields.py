"""From matched points to the displacement at every pixel, in space or in the plane of an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.deformation.textured_state import TexturedState
from sms_jobs.kinds.point_matches import trusted_points
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.deformation import displacement
from sms_jobs.metrology.deformation.displacement import blend_matches, displacement_field
from sms_jobs.metrology.deformation.matching import GridMatches
from sms_jobs.metrology.geometry.planes import in_space, pixels_as_plane
from sms_jobs.records.fields import DisplacementField, ImageMatches
from sms_jobs.records.reasons import Reason

_PIXEL_REASONS = {
    displacement.OUTSIDE_REGION: Reason.OUTSIDE_REGION,
    displacement.NO_MATCH_NEAR: Reason.NO_MATCH,
    displacement.LEFT_IMAGE: Reason.LEFT_IMAGE,
    displacement.NO_SHAPE_AT_END: Reason.NO_SHAPE_AT_END,
}


def field_in_space(
    grid: GridMatches,
    before: TexturedState,
    after: TexturedState,
    reference: str,
    parameters: CorrelateParameters,
    threads: int,
) -> DisplacementField:
    """Look the displacement of every pixel up in the measured shapes of both states."""
    # Positions that come from subsets are averages already.
    subsets = before.surface.subset_radius_px
    averaging = 0.0 if subsets else parameters.averaging_radius_px
    found = displacement_field(
        trusted_points(grid, before.regions.labels),
        _shape(before),
        _shape(after),
        before.interior,
        subset_radius=parameters.subset_radius_px,
        averaging_radius=averaging,
        threads=threads,
    )
    reason = before.surface.reason.copy()
    for status, why in _PIXEL_REASONS.items():
        reason[(found.status == status) & (reason == Reason.VALID)] = np.uint32(why)
    return DisplacementField(
        before.surface.view,
        reference,
        before.surface.unit,
        found.displacement,
        found.covariance.astype(np.float32),
        found.image_displacement,
        reason,
        averaging,
        max(parameters.subset_radius_px, subsets),
    )


def _shape(state: TexturedState) -> tuple[NDArray[np.float64], NDArray[np.floating], NDArray[np.int32]]:
    """Return positions, their covariances and the regions of a state."""
    return state.surface.position, position_covariance(state.surface), state.regions.labels


def field_in_plane(
    grid: GridMatches,
    matches: ImageMatches,
    before: TexturedState,
    reference: str,
    parameters: CorrelateParameters,
    threads: int,
) -> DisplacementField:
    """Spread the matches over the image, whose plane the specimen does not leave."""
    labels, surface = before.matched, before.surface
    image, variance = blend_matches(
        trusted_points(grid, labels),
        in_space(pixels_as_plane(labels.shape)),
        labels,
        parameters.subset_radius_px,
        threads,
    )
    near = _near_a_match(matches, labels.shape, parameters.spacing_px)
    reason = _reasons(np.isnan(image[0]) | ~near, before, matches)
    for field in (image, variance):
        field[:, reason != 0] = np.nan
    size = 1.0 if surface.mm_per_px is None else surface.mm_per_px
    u, v = image
    covariance = size**2 * np.stack([variance[0], 0.0 * variance[0], variance[1]])
    return DisplacementField(
        surface.view,
        reference,
        surface.unit,
        size * np.stack([u, -v]),
        covariance.astype(np.float32),
        image,
        reason,
        0.0,
        parameters.subset_radius_px,
    )


def _near_a_match(matches: ImageMatches, shape: tuple[int, ...], spacing_px: int) -> NDArray[np.bool_]:
    """Return the pixels within a spacing of a point that was matched, (rows, columns).

    No measured shape tells where the specimen ends: what its outermost matches would say of the background
    beyond, or of a hole, is nothing.
    """
    matched = matches.reason == 0
    near = np.zeros(shape, dtype=bool)
    near[matches.y[matched].astype(np.int64), matches.x[matched].astype(np.int64)] = True
    return np.asarray(ndimage.maximum_filter(near, 2 * spacing_px + 1))


def _reasons(missing: NDArray[np.bool_], before: TexturedState, matches: ImageMatches) -> NDArray[np.uint32]:
    """Return why pixels have no value: what the nearest point has against it, or that none is near."""
    reason = before.surface.reason.copy()
    lost = matches.reason != 0
    lacking = missing & before.of_interest & (reason == Reason.VALID)
    if lost.any() and lacking.any():
        points = cKDTree(np.stack([matches.x[lost], matches.y[lost]], axis=1))
        row, column = np.nonzero(lacking)
        _, nearest = points.query(np.stack([column, row], axis=1))
        reason[lacking] = matches.reason[lost][nearest]
    reason[lacking & (reason == 0)] = Reason.NO_MATCH
    reason[~before.of_interest] = Reason.OUTSIDE_REGION
    return reason
