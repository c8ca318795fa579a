"""Where partners see what each pixel of the reference camera sees, and the points that follow from that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.kinds.point_matches import between_matches, trusted_points
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.kinds.shape.textures import spots_of
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.deformation.fields.displacement import blend_matches
from sms_jobs.metrology.deformation.matching.camera_matching import TexturedCamera
from sms_jobs.metrology.deformation.matching.correlation import PreparedImages, Spots
from sms_jobs.metrology.deformation.matching.grid import GridMatches
from sms_jobs.metrology.deformation.matching.ray_scatter import scatter_of_places
from sms_jobs.metrology.deformation.matching.verification import verify_displacement
from sms_jobs.metrology.geometry.camera import Camera, pixel_maps
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.several_cameras import (
    SeenPoints,
    directions_across_rays,
    meet_rays,
    slopes_of_places,
)
from sms_jobs.metrology.images.masks import narrowed, widened
from sms_jobs.records.fields import PlacesSeen, Surface
from sms_jobs.records.reasons import Reason

_OFF_SIGMAS, _OFF_PX = 3.0, 0.05
"""Deviations of a match, and px, by which images may ask for another place; by more than both it is none."""


_SCATTERED = 2.2
"""Mean square, in units of the variance, from which places scatter by more than is stated of them."""


_SHAKEN = 5.0
"""Deviations of matches by noise from which their scatter is none of lenses or of coarse sampling."""


def asks_for_another_place(bias: Floats, variance: Floats) -> Mask:
    """Say where images that are compared again ask for another place than a match between cameras tells.

    Both (2, rows, columns) in px^2: the square of what they ask for, and the variance of the match.
    """
    u, v = bias > np.maximum(_OFF_SIGMAS**2 * variance, _OFF_PX**2)
    return np.asarray(u | v)


@dataclass(frozen=True)
class PartnerPlaces:
    """The matches with a partner, spread to every pixel and checked against the images.

    Attributes
    ----------
    place, variance
        (2, rows, columns): where the partner sees what the pixel sees, in px, NaN where nobody has looked or
        the images disagree, and its variances in px^2, the square of what subsets cannot follow included.
    noise
        (2, rows, columns), in px^2: what of the variances is the noise of both images.
    disagree
        (rows, columns): where there was a place at which the partner shows something else.
    lenses
        By how much the lenses of the reference camera and of the partner blur, variances in px^2.
    shaken
        (rows, columns), in px^2: what places scatter by beyond all else that is known of them, as in haze, 0
        for nothing; it is in their variances.
    """

    place: Floats
    variance: Floats
    noise: Floats
    disagree: Mask
    lenses: Spots
    shaken: Floats


def places_of_pixels(
    cameras: tuple[Camera, Camera],
    images: PreparedImages,
    found: GridMatches,
    parameters: StereoParameters,
    threads: int,
) -> PartnerPlaces:
    """Spread matches to the pixels, and compare the images again along what comes of that.

    `cameras` are the reference and the partner.
    """
    labels, radius = images.labels, parameters.subset_radius_px
    spread = blend_matches(trusted_points(found, labels), None, labels, radius, threads)
    shift = spread.value
    np.copyto(shift, np.nan, where=~between_matches(found, labels.shape, parameters.spacing_px))
    verified = verify_displacement(
        images,
        shift,
        radius,
        parameters.shape_order,
        parameters.smoothing_px,
        threads,
        across=directions_across_rays(*cameras),
    )
    place = _well_inside(pixel_maps(*labels.shape) + shift, labels.shape, parameters.edge_margin_px)
    asked, bent = _in_partner((verified.bias, spread.bias), place, radius)
    off = asks_for_another_place(asked, spread.variance + bent)
    # Windows overlap: what one of them finds is found about it too, and single pixels are chance.
    disagree = widened(narrowed(off | ~verified.agrees, 3, border_ends=True), 3) & np.isfinite(place[0])
    np.copyto(place, np.nan, where=disagree)
    filtered = spots_of(parameters.smoothing_px)
    lenses = images.spots[0] - filtered[0], images.spots[1] - filtered[1]
    variance = spread.variance + np.fmax(asked, bent)
    times = scatter_of_places(*cameras, place, variance, radius, threads)
    more = np.where(times > _SCATTERED, times - 1.0, 0.0)
    matched, noise = spread.variance.mean(axis=0), spread.noise.mean(axis=0)
    shaken = more * variance.mean(axis=0)
    shaken += np.where(matched > _SHAKEN**2 * noise, matched - noise, 0.0)
    variance *= 1.0 + more
    return PartnerPlaces(place, variance, spread.noise, disagree, lenses, shaken)


def _in_partner(variances: Sequence[Floats], place: Floats, lever: int) -> list[Floats]:
    """Return variances (2, rows, columns) in px^2 of the reference image in px^2 of the partner's at places.

    Slopes are taken over `lever` px; what has none is as large in both images.
    """
    slopes = slopes_of_places(place, lever).reshape(2, 2, -1)
    found = []
    for one in variances:
        flat, carried = one.reshape(2, -1), np.zeros(one.shape)
        some = np.flatnonzero(flat[0] + flat[1] > 0.0)  # most pixels have none
        own = slopes.take(some, axis=2)
        own = np.where(np.isnan(own), np.eye(2)[..., None], own)
        carried.reshape(2, -1)[:, some] = np.einsum("kan,an->kn", own**2, flat.take(some, axis=1))
        found.append(carried)
    return found


def _well_inside(places: Floats, shape: tuple[int, ...], margin_px: int) -> Floats:
    """Return places (2, rows, columns) in a partner's image, NaN beyond a margin from its border.

    There subsets are cut, and a place is told from those further in alone.
    """
    rows, columns = shape
    low, high = float(margin_px), np.array([columns, rows])[:, None, None] - 1.0 - margin_px
    inside = ((places >= low) & (places <= high)).all(axis=0)
    return np.asarray(np.where(inside, places, np.nan))


def points_of_pixels(
    reference: TexturedCamera,
    partners: Sequence[TexturedCamera],
    spread: Sequence[PartnerPlaces],
    lever: int,
    threads: int,
) -> SeenPoints:
    """Return the point of each pixel; `lever` is the distance in px over which slopes are taken."""
    pixels = pixel_maps(*reference.texture.shape).reshape(2, -1)
    places = np.stack([one.place.reshape(2, -1) for one in spread])
    sigma = np.stack([np.sqrt(one.variance).reshape(2, -1) for one in spread])
    slopes = np.stack([slopes_of_places(one.place, lever).reshape(2, 2, -1) for one in spread])
    cameras = [one.camera for one in partners]
    return meet_rays(reference.camera, cameras, pixels, places, sigma, slopes, threads)


def with_noise(
    surface: Surface, met: SeenPoints, spread: Sequence[PartnerPlaces], shape_order: int
) -> Surface:
    """Return a surface with what the images' noise has in its covariance, and the reference image's alone.

    That moves the matches of all partners alike, by half of their variance by noise; of several partners the
    means are taken. `shape_order` is that of the subsets.
    """
    seen = [np.isfinite(one.place) for one in spread]
    noise, variance = (
        np.sum([np.where(s, one, 0.0) for s, one in zip(seen, each, strict=True)], axis=(0, 1))
        for each in ([one.noise for one in spread], [one.variance for one in spread])
    )
    count = np.maximum(np.sum(seen, axis=(0, 1)), 1)
    own = met.by_own.reshape(2, *noise.shape) * np.sqrt(0.5 * noise / count)
    with np.errstate(invalid="ignore"):
        part = noise / variance
    bad = surface.reason != Reason.VALID
    for values in (own, part[None]):
        np.copyto(values, np.nan, where=bad)
    return replace(
        surface,
        shape_order=shape_order,
        own_noise=own.astype(np.float32),
        noise_part=part.astype(np.float32),
    )


def with_shaken_rays(surface: Surface, camera: Camera, spread: Sequence[PartnerPlaces]) -> Surface:
    """Return a surface whose points are as uncertain across the reference camera's rays as images shake.

    Nobody knows which image does, and a point lies on the ray of its pixel. What several partners show alike
    is the least of what they scatter by.
    """
    every = [np.where(np.isfinite(one.place[0]), one.shaken, np.inf) for one in spread]
    shaken = np.min(every, axis=0)
    some = np.isfinite(surface.position[0]) & (shaken > 0.0) & np.isfinite(shaken)
    if not some.any():
        return surface
    assert surface.covariance is not None
    assert surface.noise_part is not None
    ray = surface.position[:, some] - camera.pose.centre()[:, None]
    depth = camera.pose.matrix()[2] @ ray
    ray /= np.linalg.norm(ray, axis=0)
    square = shaken[some] * depth**2 / (camera.intrinsics.fx * camera.intrinsics.fy)
    covariance, part = surface.covariance.copy(), surface.noise_part.copy()
    before = covariance[:, some]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    after = before + np.stack([square * (float(i == j) - ray[i] * ray[j]) for i, j in pairs])
    covariance[:, some] = after
    part[some] *= trace(before) / trace(after)
    return replace(surface, covariance=covariance, noise_part=part)


def held_against_the_images(surface: Surface, spread: Sequence[PartnerPlaces]) -> Surface:
    """Return the surface with the reason of pixels that no partner shows as the reference camera does."""
    disagree = np.any([one.disagree for one in spread], axis=0) & np.isnan(surface.position[0])
    unseen = disagree & (surface.reason == Reason.NO_MATCH)
    return replace(surface, reason=np.where(unseen, np.uint32(Reason.IMAGES_DISAGREE), surface.reason))


def places_seen(camera: str, spread: PartnerPlaces, surface: Surface) -> PlacesSeen:
    """Return what is kept of a partner's places: those that the surface has been made of."""
    shift = spread.place - pixel_maps(*surface.reason.shape)
    np.copyto(shift, np.nan, where=surface.reason != Reason.VALID)
    own, other = (float(np.sqrt(lens)) for lens in spread.lenses)
    return PlacesSeen(camera, shift.astype(np.float32), own, other)
