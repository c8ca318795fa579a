"""Matching of one camera's texture with another's at one time: points of a grid, each verified both ways."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Labels
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    LEFT_IMAGE,
    NO_TEXTURE,
    NOT_CONVERGED,
    TOO_FEW_PIXELS,
    Matches,
    MatchSettings,
    Noise,
    PreparedImages,
    match_points,
)
from sms_jobs.metrology.deformation.matching.epipolar_search import (
    FoundSeeds,
    Width,
    best_of,
    search_along_rays,
)
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings, Seeds, spread_matches
from sms_jobs.metrology.deformation.matching.ray_scatter import stated_by_rays
from sms_jobs.metrology.deformation.matching.sampling import Nodes, choose_seeds
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings, seed_displacements
from sms_jobs.metrology.deformation.matching.shape_functions import WARP, carried
from sms_jobs.metrology.deformation.matching.spots import measured_spots
from sms_jobs.metrology.geometry.camera import Camera, project
from sms_jobs.metrology.geometry.several_cameras import depths_in_box, points_along_rays

Corner: TypeAlias = tuple[float, float, float]

_SURE = 0.6  # correlation from which on a surface that faces the cameras explains a place
_SEED_SCORE = 0.4  # of a place to a pixel: a poor start, but the refinement judges it
_MISFIT = 12.0  # variance left over, in medians: on a curved panel no more than 8, across a step 50 to 500
_TRIALS = 3  # of spots, each half as much wider as the one before
_AS_MANY = 2.0 / 3.0  # of the first points must be matched with wider spots, too
_RETURN_SIGMAS = 4.0  # by which a point may come back beside where it set out
_RETURN_PX = 0.05  # and at least: what two subsets of different shapes may differ by
_RETURN_RADIUS = 2.0 / 3.0  # of the subsets on the way back: a quarter of the time, and a second opinion


@dataclass(frozen=True)
class TexturedCamera:
    """A camera, what it saw, (rows, columns) in grey levels, and the noise of that."""

    camera: Camera
    texture: NDArray[np.floating]
    noise: Noise


@dataclass(frozen=True)
class RaySearch:
    """Where first matches are looked for.

    Attributes
    ----------
    volume
        Two corners of the box in mm that the points lie in.
    width
        How far off the images of the rays: what the calibration may be wrong by.
    template_radius
        Half the side of the squares that are compared, in px.
    spacing
        Between them, in px.
    """

    volume: tuple[Corner, Corner]
    width: Width
    template_radius: int = 20
    spacing: int = 96


def match_cameras(
    reference: TexturedCamera,
    partner: TexturedCamera,
    images: PreparedImages,
    nodes: Nodes,
    settings: MatchSettings,
    grid: GridSettings,
    search: RaySearch,
    threads: int = 1,
) -> tuple[GridMatches, PreparedImages]:
    """Find the points of a grid of the reference camera in the image of a partner of the same size.

    Parameters
    ----------
    reference, partner
        What both saw at one time.
    images
        Both textures, prepared, with labels where that of the reference shows the specimen.
    nodes
        The points.
    settings, grid, search
        Of the subsets, of what is accepted, and of the first matches.
    threads
        How many threads to use; the result does not depend on it.

    Returns
    -------
    The matches, and the images with the spots that both cameras have been found to have.
    """
    if len(nodes.x) == 0:
        return spread_matches(images, nodes, Seeds.none(), settings, grid, threads), images
    squares = SearchSettings(template_radius=search.template_radius, spacing=search.spacing)
    first = choose_seeds(images.labels, nodes.x, nodes.y, squares)
    facing = _first_matches(reference, partner, nodes, first, search, threads)
    seeds = _likely(first, facing, _SURE)
    images = _as_blurred(images, nodes, seeds, settings, threads)
    result = spread_matches(images, nodes, seeds, settings, grid, threads)
    # What they have not led to may be tilted more: where there is such a place, matching goes on from there.
    lost = np.flatnonzero((facing.score < _SURE) & (result.matches.ending[first] != CONVERGED))
    if len(lost):
        tilted = _first_matches(reference, partner, nodes, first[lost], search, threads, tilted=True)
        seeds = _likely(first[lost], best_of([facing.only(lost), tilted]), _SEED_SCORE)
        if len(seeds.points):
            known = _matched_of(result)
            result = spread_matches(images, nodes, seeds, settings, grid, threads, known=known)
    refuse_misfits(result.matches)
    result = stated_by_rays(reference.camera, partner.camera, result, settings.radius, grid.spacing, threads)
    missed, allowed = _way_back(images, result, settings, threads)
    with np.errstate(invalid="ignore"):
        result.matches.ending[missed > allowed] = NOT_CONVERGED
    return result, images


def _as_blurred(
    images: PreparedImages, nodes: Nodes, seeds: Seeds, settings: MatchSettings, threads: int
) -> PreparedImages:
    """Return the images with spots as wide as the first matches say.

    A reference image that is much less sharp than the partner's cannot be made as sharp: what is added then
    drowns in its own noise, and nothing is matched. So half of what is measured is taken, and so on, if with
    it clearly fewer of the first points are matched than without.
    """
    x, y = nodes.x[seeds.points], nodes.y[seeds.points]
    first = match_points(images, x, y, seeds.guess, settings, threads)
    least = images.spots
    more = np.subtract(measured_spots(images, x, y, first, settings), least)
    good = first.ending == CONVERGED
    x, y, guess = x[good], y[good], first.warp[good]
    for _ in range(_TRIALS):
        trial = replace(images, spots=(least[0] + float(more[0]), least[1] + float(more[1])))
        again = match_points(trial, x, y, guess, settings, threads)
        if (again.ending == CONVERGED).sum() >= _AS_MANY * len(x):
            return trial
        more = 0.5 * more
    return images


def refuse_misfits(found: Matches) -> None:
    """Give up matches that leave over far more than others: half of their subset is of another surface.

    How much a good one leaves over depends on the images: noise that nobody knows, blur that is not the same
    in both. So the median of all is the measure.
    """
    matched = found.ending == CONVERGED
    if matched.any():
        usual = max(1.0, float(np.median(found.misfit[matched])))
        found.ending[matched & (found.misfit > _MISFIT * usual)] = NOT_CONVERGED


def _likely(points: Ints, found: FoundSeeds, least_score: float) -> Seeds:
    """Return what was found at points as seeds, where it is good enough and nothing else is about as good."""
    likely = (found.score >= least_score) & found.unique
    return Seeds(points[likely], found.warp[likely])


def _matched_of(found: GridMatches) -> GridMatches:
    """Return the points that have a match."""
    good = found.matches.ending == CONVERGED
    matches = Matches(*(values[good] for values in vars(found.matches).values()))
    return GridMatches(found.x[good], found.y[good], matches)


def _first_matches(
    reference: TexturedCamera,
    partner: TexturedCamera,
    nodes: Nodes,
    points: Ints,
    search: RaySearch,
    threads: int,
    *,
    tilted: bool = False,
) -> FoundSeeds:
    """Return what is found for some of the nodes along their rays."""
    pixels = np.stack([nodes.x[points], nodes.y[points]], axis=1).astype(np.float64)
    return search_along_rays(
        reference.camera,
        partner.camera,
        (reference.texture, partner.texture),
        pixels,
        search.volume,
        radius=search.template_radius,
        width=search.width,
        tilted=tilted,
        threads=threads,
    )


def _way_back(
    images: PreparedImages, found: GridMatches, settings: MatchSettings, threads: int
) -> tuple[Floats, Floats]:
    """Match smaller subsets of the partner with the reference image; return by how many px they miss nodes.

    And by how many they may: NaN for what was not matched, or has too little texture for a second opinion.
    """
    matched = found.matches.ending == CONVERGED
    missed, allowed = np.full((2, len(found.x)), np.nan)
    if not matched.any():
        return missed, allowed
    warp = found.matches.warp[matched]
    start = np.stack([found.x[matched], found.y[matched]], axis=1).astype(np.float64)
    place = start + warp[:, [0, 3]]
    rows, columns = images.deformed.shape
    pixel = np.clip(np.rint(place), 0, [columns - 1, rows - 1]).astype(np.int64)
    slope = np.stack([1.0 + warp[:, 1], warp[:, 2], warp[:, 4], 1.0 + warp[:, 5]], axis=1).reshape(-1, 2, 2)
    back = np.linalg.inv(slope)
    off = (pixel - place)[..., None]
    smaller = replace(settings, radius=max(5, round(_RETURN_RADIUS * settings.radius)), shape_order=1)
    bent = _taken_for_a_shift(warp, back, smaller.radius)
    # Where a match that is right will end, so that four in five need one step.
    home = start + bent + (back @ off)[..., 0] - pixel
    guess = np.stack(
        [home[:, 0], back[:, 0, 0] - 1.0, back[:, 0, 1], home[:, 1], back[:, 1, 0], back[:, 1, 1] - 1.0],
        axis=1,
    )
    x, y = (np.ascontiguousarray(values) for values in pixel.T)
    again: Matches = match_points(images.way_back(), x, y, guess, smaller, threads)
    there = carried(again.warp, *(place - pixel).T)
    distance = np.hypot(*(place + there[:, [0, 3]] - bent - start).T)
    distance[np.isin(again.ending, (LEFT_IMAGE, NOT_CONVERGED))] = np.inf
    missed[matched] = np.where(np.isin(again.ending, (NO_TEXTURE, TOO_FEW_PIXELS)), np.nan, distance)
    sigma = np.hypot(found.matches.sigma[matched].max(axis=1), np.nan_to_num(again.sigma.max(axis=1)))
    allowed[matched] = np.maximum(_RETURN_PX, _RETURN_SIGMAS * sigma)
    return missed, allowed


def _taken_for_a_shift(warp: Floats, back: Floats, radius: int) -> Floats:
    """Return what second derivatives shift subsets of first order by on the way back, (n, 2) in px.

    A subset of first order takes the mean of the second derivatives' part over its square for a shift. With
    slopes `back` (n, 2, 2) of the inverse its second derivatives are -back (back^T u,ij back).
    """
    if warp.shape[1] < WARP:
        return np.zeros((len(warp), 2))
    xx, xy, yy = warp[:, 6::3], warp[:, 7::3], warp[:, 8::3]
    metric = back @ np.swapaxes(back, 1, 2)
    along = xx * metric[:, :1, 0] + 2.0 * xy * metric[:, :1, 1] + yy * metric[:, 1:, 1]
    return np.asarray(-radius * (radius + 1) / 6.0 * (back @ along[..., None])[..., 0])


def distance_from_rays(
    reference: TexturedCamera,
    partner: TexturedCamera,
    labels: Labels,
    nodes: Nodes,
    volume: tuple[Corner, Corner],
    count: int = 12,
    threads: int = 1,
) -> float:
    """Return how far off the images of their rays, in px, textures are found that are looked for everywhere.

    The median of up to `count` points; NaN where no texture of the reference image is in the partner's. It
    tells why nothing was found: images that have nothing in common, or a calibration that is not theirs.
    """
    rows, columns = reference.texture.shape
    where = SearchSettings(columns, rows, template_radius=24, spacing=max(rows, columns) // 4)
    first = choose_seeds(labels, nodes.x, nodes.y, where)[:count]
    x, y = nodes.x[first], nodes.y[first]
    u, v, score = seed_displacements(reference.texture, partner.texture, labels, x, y, where, threads)
    pixels = np.stack([x, y], axis=1).astype(np.float64)
    rays, near, far = depths_in_box(reference.camera, pixels, *volume)
    points = points_along_rays(reference.camera, rays, near, far, 1000)
    line = project(partner.camera.intrinsics, partner.camera.pose, points)
    found = pixels + np.stack([u, v], axis=1)
    off = np.linalg.norm(line - found[:, None], axis=-1)
    usable = (score >= 0.6) & np.isfinite(off).any(axis=1)
    return float(np.median(np.nanmin(off[usable], axis=1))) if usable.any() else float("nan")
