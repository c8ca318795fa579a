"""Matches of points that somebody expects somewhere, spread to the pixels and held against the images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters, match_settings
from sms_jobs.kinds.point_matches import between_matches, trusted_points
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.deformation.fields.displacement import blend_matches, blending_reach
from sms_jobs.metrology.deformation.matching.camera_matching import refuse_misfits
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    NOT_CONVERGED,
    PreparedImages,
    match_points,
)
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings, is_sure
from sms_jobs.metrology.deformation.matching.sampling import sample_nodes
from sms_jobs.metrology.deformation.matching.shape_functions import WARP
from sms_jobs.metrology.deformation.matching.verification import verify_displacement
from sms_jobs.metrology.geometry.several_cameras import slopes_of_places
from sms_jobs.metrology.images.masks import widened

_BENT = 2.0
"""Variance of a match over that of noise, from which on subsets of second order are tried, too."""


@dataclass(frozen=True)
class FollowedMatches:
    """Matches at every pixel of the image that they were made in, and what both images say of them.

    Attributes
    ----------
    moved, variance, noise, bias
        (2, rows, columns): in px, and in px^2.
    agrees
        (rows, columns), whether both images show the same thing.
    """

    moved: Floats
    variance: Floats
    noise: Floats
    bias: Floats
    agrees: Mask

    def or_where_better(self, other: FollowedMatches, where: Mask) -> FollowedMatches:
        """Return the other's values where they are wanted, known, and state a smaller error."""
        mine, theirs = ((one.variance + one.bias).sum(axis=0) for one in (self, other))
        with np.errstate(invalid="ignore"):
            better = where & other.agrees & (theirs < mine)
        return FollowedMatches(
            *(np.where(better, t, m) for m, t in zip(vars(self).values(), vars(other).values(), strict=True))
        )


def match_and_spread(
    images: PreparedImages,
    expected: Floats,
    subsets: Subsets,
    parameters: CorrelateParameters,
    threads: int,
    *,
    between: bool = False,
) -> FollowedMatches:
    """Match points from where they are expected, (2, rows, columns) in px, and spread them to the pixels.

    What is matched `between` cameras is refused where it leaves over too much, and ends at its last points.
    """
    labels = images.labels
    found = _matched(images, expected, subsets, parameters, threads)
    if between:
        refuse_misfits(found.matches)
    spread = blend_matches(trusted_points(found, labels), None, labels, subsets.radius, threads)
    if between:
        spread.value[:, ~between_matches(found, labels.shape, parameters.spacing_px)] = np.nan
    verified = verify_displacement(
        images, spread.value, subsets.radius, subsets.order, parameters.smoothing_px, threads
    )
    variance = spread.variance + spread.bias
    return FollowedMatches(spread.value, variance, spread.noise, verified.bias, verified.agrees)


def follow_bends(
    images: PreparedImages,
    spread: FollowedMatches,
    expected: Floats,
    subsets: Subsets,
    parameters: CorrelateParameters,
    threads: int,
) -> FollowedMatches:
    """Return what subsets of first order have found or, where they leave over much, those of second order.

    A tilt of a curved surface bends the image of each camera. Between the shapes of two states that moves the
    end along the surface alone, between rays it moves the depth.
    """
    bent = spread.variance.sum(axis=0) > _BENT * spread.noise.sum(axis=0)
    if subsets.order != 1 or not bent.any():
        return spread
    near = widened(bent, 2 * int(np.ceil(blending_reach(subsets.radius, WARP))) + 1)
    wanted = np.where(near, expected, np.nan)
    other = match_and_spread(images, wanted, replace(subsets, order=2), parameters, threads)
    return spread.or_where_better(other, bent)


def _matched(
    images: PreparedImages, expected: Floats, subsets: Subsets, parameters: CorrelateParameters, threads: int
) -> GridMatches:
    """Match points of a grid from where they are expected, (2, rows, columns) in px."""
    nodes = sample_nodes(images.labels, parameters.spacing_px, parameters.edge_spacing_px)
    guess = _guess(expected, subsets)[:, nodes.y, nodes.x].T
    guess[:, [0, 3]] -= np.stack([nodes.x, nodes.y], axis=1)
    known = np.isfinite(guess[:, 0])
    x, y = nodes.x[known], nodes.y[known]
    settings = replace(
        match_settings(parameters, parameters.minimum_subset_part),
        radius=subsets.radius,
        shape_order=subsets.order,
    )
    found = match_points(images, x, y, np.nan_to_num(guess[known]), settings, threads)
    limits = GridSettings(minimum_score=parameters.minimum_score, maximum_sigma=parameters.maximum_sigma_px)
    ending = np.where(is_sure(found, limits), CONVERGED, NOT_CONVERGED).astype(np.int32)
    return GridMatches(x, y, replace(found, ending=ending))


def _guess(expected: Floats, subsets: Subsets) -> Floats:
    """Return the warp at every pixel by what is expected, (6 or 12, rows, columns), with places for shifts.

    Bends are part of it where subsets have them: left to the iteration they would be found last, and what
    they are still wrong by when it ends moves all places of a curved surface the same way.
    """
    slopes = slopes_of_places(expected, subsets.radius)
    numbers = [expected[0], *slopes[0], expected[1], *slopes[1]]
    if subsets.order == 2:
        for slope in slopes:
            (xx, xy), (_, yy) = slopes_of_places(slope, subsets.radius)
            numbers += [xx, xy, yy]
    warp = np.stack(numbers)
    warp[[1, 5]] -= 1.0
    return warp
