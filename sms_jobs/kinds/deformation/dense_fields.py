"""From matched points to the displacement at every pixel, in space or in the plane of an image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.deformation.textured_state import TexturedState
from sms_jobs.kinds.point_matches import trusted_points
from sms_jobs.kinds.resolution import extent_of_pixels, resolution_of_matches
from sms_jobs.kinds.surface_ports import independent_covariance, position_covariance
from sms_jobs.metrology.deformation.fields import displacement
from sms_jobs.metrology.deformation.fields.common_noise import CommonNoise
from sms_jobs.metrology.deformation.fields.displacement import StateShape, blend_matches, displacement_field
from sms_jobs.metrology.deformation.fields.noise_correlation import noise_correlation_at
from sms_jobs.metrology.deformation.matching.correlation import PreparedImages
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.matching.grid import GridMatches
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.deformation.matching.verification import Verified, verify_displacement
from sms_jobs.metrology.images.masks import narrowed, widened
from sms_jobs.records.fields import DisplacementField, ImageMatches, Surface
from sms_jobs.records.reasons import Reason

_PIXEL_REASONS = {
    displacement.OUTSIDE_REGION: Reason.OUTSIDE_REGION,
    displacement.NO_MATCH_NEAR: Reason.NO_MATCH,
    displacement.LEFT_IMAGE: Reason.LEFT_IMAGE,
    displacement.NO_SHAPE_AT_END: Reason.NO_SHAPE_AT_END,
}


@dataclass(frozen=True)
class ImageDisplacement:
    """The matches of points, spread to every pixel and checked against the images.

    Attributes
    ----------
    value
        (2, rows, columns): u and v in px.
    variance
        (2, rows, columns), of u and v by noise, in px^2.
    verified
        What the images say.
    noise
        (2, rows, columns), what of the variance is the noise of the two images, in px^2.
    correlation
        (rows, columns), of what an image's noise does to this match and to that between cameras which has
        made the surface; 0 where none has.
    """

    value: NDArray[np.float64]
    variance: NDArray[np.float64]
    verified: Verified
    noise: NDArray[np.float64]
    correlation: NDArray[np.float64]

    def without(self, out: NDArray[np.bool_]) -> ImageDisplacement:
        """Return it with pixels (rows, columns) on which the images are known to disagree."""
        return replace(self, verified=replace(self.verified, agrees=self.verified.agrees & ~out))


def spread(
    grid: GridMatches,
    images: PreparedImages,
    before: TexturedState,
    parameters: CorrelateParameters,
    threads: int,
) -> ImageDisplacement:
    """Spread the matches over their regions, and verify what comes of that."""
    surface, labels = before.surface, before.match_regions
    position = surface.position if surface.has_depth else None
    found = blend_matches(
        trusted_points(grid, labels), position, labels, parameters.subset_radius_px, threads
    )
    verified = verify_displacement(
        images,
        found.value,
        parameters.subset_radius_px,
        parameters.shape_order,
        parameters.smoothing_px,
        threads,
    )
    # Beside borders matches tell of bends that images, of which less is seen there, may not.
    verified = replace(verified, bias=np.fmax(verified.bias, found.bias))
    correlation = _noise_in_common(surface, labels, parameters)
    return ImageDisplacement(found.value, found.variance, verified, found.noise, correlation)


def _noise_in_common(
    surface: Surface, labels: NDArray[np.int32], parameters: CorrelateParameters
) -> NDArray[np.float64]:
    """Return the correlation of what one image's noise does to the match in time and to the surface.

    0 where it does nothing to the surface, and where the match is not one of two images by subsets.
    """
    direct = parameters.method == "gauss-newton" and parameters.reference == "first"
    if surface.own_noise is None or surface.shape_order is None or not direct:
        return np.zeros(labels.shape)
    return noise_correlation_at(
        labels,
        Subsets(parameters.subset_radius_px, cast(ShapeOrder, parameters.shape_order)),
        Subsets(surface.subset_radius_px, cast(ShapeOrder, surface.shape_order)),
        parameters.edge_margin_px,
    )


def field_in_space(
    image: ImageDisplacement,
    before: TexturedState,
    after: TexturedState,
    reference: str,
    parameters: CorrelateParameters,
    resolution: NDArray[np.float64],
    threads: int,
) -> DisplacementField:
    """Look the displacement of every pixel up in the measured shapes of both states."""
    # Positions that come from subsets are averages already.
    subsets = before.surface.subset_radius_px
    averaging = 0.0 if subsets else parameters.averaging_radius_px
    agrees = image.verified.agrees
    found = displacement_field(
        image.value,
        image.variance,
        image.verified.bias,
        _shape(before),
        _shape(after),
        before.interior & agrees,
        averaging_radius=averaging,
        threads=threads,
        common=_common_noise(image, before),
    )
    reason = before.surface.reason.copy()
    for status, why in _PIXEL_REASONS.items():
        reason[(found.status == status) & (reason == Reason.VALID)] = np.uint32(why)
    reason[~agrees & (before.surface.reason == Reason.VALID)] = np.uint32(Reason.IMAGES_DISAGREE)
    for values in (found.displacement, found.covariance, found.image_displacement, found.bias):
        np.copyto(values, np.nan, where=reason != 0)
    radius = max(parameters.subset_radius_px, subsets)
    return DisplacementField(
        before.surface.view,
        reference,
        before.surface.unit,
        found.displacement,
        found.covariance,
        found.image_displacement,
        reason,
        averaging,
        radius,
        found.bias,
        **_told_resolution(resolution, before, reason, radius),
        **_told_subsets(before, parameters),
    )


def _common_noise(image: ImageDisplacement, before: TexturedState) -> CommonNoise | None:
    """Return what match and shapes have in common, if anything."""
    if before.pin_hole is None or not image.correlation.any():
        return None
    return CommonNoise(image.noise, image.correlation, np.array(before.pin_hole))


def resolution_in_image(grid: GridMatches, before: TexturedState, parameters: CorrelateParameters) -> float:
    """Return the spatial resolution of displacement in px.

    Where shape comes from matches between cameras it is that of the coarser of the two.
    """
    surface = before.surface
    averaged = surface.has_depth and not surface.subset_radius_px
    found = resolution_of_matches(
        parameters.subset_radius_px,
        cast(ShapeOrder, _order(parameters)),
        grid.matches.warp.shape[1],
        parameters.spacing_px,
        parameters.averaging_radius_px if averaged else 0.0,
    )
    return max(found, surface.resolution_px or 0.0)


def _told_resolution(
    resolution: NDArray[np.float64], before: TexturedState, reason: NDArray[np.uint32], radius: int
) -> dict[str, Any]:
    """Return what a record says of a resolution, (rows, columns) in px: its median, and on the surface."""
    valid = reason == Reason.VALID
    if not valid.any():
        return {}
    on_surface = resolution * extent_of_pixels(before.surface, before.match_regions, radius)
    return {
        "resolution_px": float(np.median(resolution[valid])),
        "resolution": np.where(valid, on_surface, np.nan).astype(np.float32),
    }


def _order(parameters: CorrelateParameters) -> int:
    """Return the order of the deformation that is matched: a peak of the cross-correlation is a shift."""
    return 0 if parameters.method == "fourier-newton" else parameters.shape_order


def _told_subsets(before: TexturedState, parameters: CorrelateParameters) -> dict[str, Any]:
    """Return what a record says of the subsets that were matched in time, which adaptive ones begin with."""
    return {
        "match_radius_px": parameters.subset_radius_px,
        "match_order": _order(parameters),
        "match_margin_px": parameters.edge_margin_px if before.surface.has_depth else 0,
    }


def _shape(state: TexturedState) -> StateShape:
    surface = state.surface
    return StateShape(
        surface.position,
        position_covariance(surface),
        state.regions.labels,
        independent_covariance(surface),
        surface.own_noise,
    )


def field_in_plane(
    image: ImageDisplacement,
    matches: ImageMatches,
    before: TexturedState,
    reference: str,
    parameters: CorrelateParameters,
    resolution: NDArray[np.float64],
) -> DisplacementField:
    """Return the displacement in the plane of the image, which the specimen does not leave."""
    surface, value, bias = before.surface, image.value, image.verified.bias
    near = _near_a_match(matches, before.match_regions, parameters.spacing_px)
    reason = _reasons(np.isnan(value[0]) | ~near, before, matches)
    reason[~image.verified.agrees & (surface.reason == Reason.VALID) & before.of_interest] = np.uint32(
        Reason.IMAGES_DISAGREE
    )
    for field in (value, bias):
        np.copyto(field, np.nan, where=reason != 0)
    size = 1.0 if surface.mm_per_px is None else surface.mm_per_px
    u, v = value
    own, biased = (size**2 * np.stack([v[0], 0.0 * v[0], v[1]]) for v in (image.variance, bias))
    return DisplacementField(
        surface.view,
        reference,
        surface.unit,
        size * np.stack([u, -v]),
        (own + biased).astype(np.float32),
        value,
        reason,
        0.0,
        parameters.subset_radius_px,
        biased.astype(np.float32),
        **_told_resolution(resolution, before, reason, parameters.subset_radius_px),
        **_told_subsets(before, parameters),
    )


def _near_a_match(matches: ImageMatches, labels: NDArray[np.int32], spacing_px: int) -> NDArray[np.bool_]:
    """Return the pixels within a spacing of a point that was matched, (rows, columns).

    No measured shape tells where the specimen ends: what its outermost matches would say of the background
    beyond, or of a hole, is nothing. Near the outline of a region, which background may have got into, it is
    half a spacing: there a pixel farther out belongs to a point that could not be matched.
    """
    matched = matches.reason == 0
    near = np.zeros(labels.shape, dtype=bool)
    near[matches.y[matched].astype(np.int64), matches.x[matched].astype(np.int64)] = True
    near = widened(near, 2 * spacing_px + 1)
    between = narrowed(near, 2 * (spacing_px - spacing_px // 2) + 1)
    deep = narrowed(labels > 0, 4 * spacing_px + 1)
    return np.asarray(near & (between | deep))


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
