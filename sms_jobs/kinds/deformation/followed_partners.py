"""Displacement by where each camera sees a point later, found from the first images instead of a new shape.

The shape of the later state still tells where to look, and what has come apart; no value comes of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.deformation.dense_fields import ImageDisplacement
from sms_jobs.kinds.deformation.followed_matches import FollowedMatches, follow_bends, match_and_spread
from sms_jobs.kinds.deformation.textured_state import CALIBRATION_OF_SHAPE, TexturedState
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Inputs, Need, Port
from sms_jobs.kinds.products import CALIBRATED, MEASURED, PLACES
from sms_jobs.kinds.shape.partner_places import asks_for_another_place
from sms_jobs.kinds.shape.textures import spots_of, white_texture
from sms_jobs.kinds.surface_ports import StatePorts, position_covariance
from sms_jobs.metrology.arrays import Floats, Labels, Mask
from sms_jobs.metrology.deformation.fields.followed_points import (
    FollowedPlaces,
    FollowedPoints,
    StartPlaces,
    followed_displacement,
)
from sms_jobs.metrology.deformation.matching.correlation import (
    PreparedImages,
    Spots,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.geometry.camera import Camera, pixel_maps, project
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.several_cameras import slopes_of_places
from sms_jobs.metrology.images.interpolation import interpolate_in_region
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import View, view_of

CALIBRATION_AT_REST = Port("calibration_at_rest", CALIBRATION, (CALIBRATED,))
PARTNERS_AT_REST = Port("reference_partner", MEASUREMENT, (MEASURED,), several=True)
PARTNERS = Port("partner", MEASUREMENT, (MEASURED,), several=True)

_MISS_SIGMAS = 6.0
"""Largest gap of the rays, in units of what the matches state and, where that is more, of the median gap."""
_AT_ONCE = 1 << 17
"""Points whose rays are met at a time, so that memory does not grow with the image."""
_NOWHERE = -10.0


def needs_of_partners(
    campaign: Campaign, subject: Subject, parameters: CorrelateParameters
) -> Iterable[Need]:
    """Yield what following partners needs beside both states; raise `InvalidInput` for a view without any."""
    if parameters.following == "each-state":
        return
    view = view_of(subject.view)
    if view.projectors or not view.other_cameras:
        raise InvalidInput(
            f"{subject} cannot be followed with following = {parameters.following}, which is of views of "
            f"several cameras without a projector, as C1C2; leave it out for {view}"
        )
    at_rest = replace(subject, state=campaign.reference.label)
    yield CALIBRATION_AT_REST.of(at_rest)
    yield from map(PARTNERS_AT_REST.of, at_rest.recordings[1:])
    yield from map(PARTNERS.of, subject.recordings[1:])


@dataclass(frozen=True)
class _Scene:
    """What following has to go by: both states' cameras, first places and where to look for the last ones.

    Places are (2, rows, columns) in px for each partner, NaN where there is none; spots are those of the
    filtered images of the reference camera and of each partner.
    """

    cameras: tuple[list[Camera], list[Camera]]
    first: list[Floats]
    spots: list[Spots]
    expected: list[Floats]


@dataclass(frozen=True)
class _End:
    """Where a partner sees later what each pixel sees, and where its images do not agree on that."""

    places: FollowedPlaces
    disagree: Mask


def followed_field(
    inputs: Inputs,
    ports: StatePorts,
    field: DisplacementField,
    images: PreparedImages,
    image: ImageDisplacement,
    before: TexturedState,
    parameters: CorrelateParameters,
) -> DisplacementField:
    """Return the displacement by where all cameras see each point, from that by the shapes of both states.

    `image` is what the reference camera's `images` have said. What has no value by the shapes gets none.
    """
    own = follow_bends(
        images,
        FollowedMatches(
            field.image_displacement,
            image.variance,
            image.noise,
            image.verified.bias,
            image.verified.agrees,
        ),
        pixel_maps(*field.reason.shape) + field.image_displacement,
        Subsets(parameters.subset_radius_px, cast(ShapeOrder, parameters.shape_order)),
        parameters,
        inputs.threads,
    )
    field = replace(field, image_displacement=own.moved)
    scene = _scene(inputs, ports, field, before, parameters.smoothing_px)
    at_rest, later = inputs.about(PARTNERS_AT_REST), inputs.about(PARTNERS)
    ends = []
    for k, (first, last) in enumerate(zip(at_rest, later, strict=True)):
        if parameters.following == "own-reference":
            ends.append(_by_own_texture(inputs, (first, last), scene, k, before, parameters))
        else:
            ends.append(_by_first_image(inputs, last, scene, k, before, parameters))
    wanted = (field.reason == Reason.VALID) & np.any(
        [np.isfinite(one.places.place[0]) for one in ends], axis=0
    )
    found = _met(
        scene,
        own,
        image.correlation,
        before,
        [one.places for one in ends],
        wanted,
        parameters,
        inputs.threads,
    )
    return _told(field, found, wanted, np.any([one.disagree for one in ends], axis=0))


def _cameras(calibration: Calibration, view: View) -> list[Camera]:
    sensors = (calibration.rig.sensor(name) for name in (view.camera, *view.other_cameras))
    return [Camera(s.intrinsics, s.pose, s.columns, s.rows) for s in sensors]


def _scene(
    inputs: Inputs, ports: StatePorts, field: DisplacementField, before: TexturedState, smoothing_px: float
) -> _Scene:
    view = inputs.view
    cameras = tuple(
        _cameras(inputs.read(port, CALIBRATED), view) for port in (CALIBRATION_AT_REST, CALIBRATION_OF_SHAPE)
    )
    pixels = pixel_maps(*field.reason.shape)
    seen = [inputs.read(ports.surface.port, PLACES.of(name)) for name in view.other_cameras]
    first = [pixels + one.shift for one in seen]
    own, other = spots_of(smoothing_px)
    spots = [(own + one.reference_blur_px**2, other + one.blur_px**2) for one in seen]
    end = before.surface.position + field.displacement
    expected = [_as_seen(camera, end) for camera in cameras[1][1:]]
    return _Scene((cameras[0], cameras[1]), first, spots, expected)


def _as_seen(camera: Camera, points: Floats) -> Floats:
    """Return where a camera sees points (3, rows, columns) in mm, (2, rows, columns) in px."""
    place = np.full((2, *points.shape[1:]), np.nan)
    known = np.isfinite(points[0])
    place[:, known] = project(camera.intrinsics, camera.pose, np.ascontiguousarray(points[:, known].T)).T
    return place


def _by_own_texture(
    inputs: Inputs,
    recordings: tuple[Subject, Subject],
    scene: _Scene,
    partner: int,
    before: TexturedState,
    parameters: CorrelateParameters,
) -> _End:
    """Follow a partner's texture from its own first image."""
    start, shape = scene.first[partner], before.surface.reason.shape
    everywhere = np.ones(shape, dtype=bool)
    ports = (PARTNERS_AT_REST, PARTNERS)
    (first, first_noise), (last, last_noise) = (
        white_texture(inputs.read(port, MEASURED, own), parameters.smoothing_px, everywhere)
        for port, own in zip(ports, recordings, strict=True)
    )
    labels, shift = _as_partner_sees(start, scene.expected[partner] - start, before.matched)
    images = prepare_images(
        first,
        last,
        labels,
        (first_noise, last_noise),
        parameters.interpolation,
        spots=spots_of(parameters.smoothing_px),
    )
    subsets = Subsets(parameters.subset_radius_px, cast(ShapeOrder, parameters.shape_order))
    expected = pixel_maps(*shape) + shift
    spread = match_and_spread(images, expected, subsets, parameters, inputs.threads)
    spread = follow_bends(images, spread, expected, subsets, parameters, inputs.threads)
    known = np.isfinite(spread.moved[0]) & spread.agrees
    x, y = (np.where(np.isfinite(axis), axis, _NOWHERE) for axis in start)
    there, _, slopes = interpolate_in_region(
        spread.moved, spread.variance[:0], np.where(known, labels, 0).astype(np.int32), x, y, inputs.threads
    )
    slopes[0, 0] += 1.0
    slopes[1, 1] += 1.0
    row, column = (
        np.clip(np.rint(axis), 0, size - 1).astype(int) for axis, size in zip((y, x), shape, strict=True)
    )
    variance, noise, bias = (one[:, row, column] for one in (spread.variance, spread.noise, spread.bias))
    there[:, ~np.isfinite(variance).all(axis=0)] = np.nan
    place = start + there
    return _End(
        FollowedPlaces(place, variance, noise, bias, slopes),
        np.isfinite(start[0]) & ~spread.agrees[row, column],
    )


def _as_partner_sees(start: Floats, shift: Floats, regions: Labels) -> tuple[Labels, Floats]:
    """Bring regions (rows, columns), and what shifts them, to the pixels of a partner that sees them."""
    labels, moved = np.zeros(regions.shape, dtype=np.int32), np.full(start.shape, np.nan)
    x, y = np.rint(start)
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (y >= 0) & (x < regions.shape[1]) & (y < regions.shape[0]) & (regions > 0)
    at = y[inside].astype(int), x[inside].astype(int)
    labels[at] = regions[inside]
    moved[:, *at] = shift[:, inside]
    # Some lie between those that the reference camera's pixels hit.
    labels = ndimage.grey_closing(labels, (3, 3)).astype(np.int32)
    return labels, _filled(moved, labels > 0)


def _filled(values: Floats, wanted: Mask) -> Floats:
    """Return values (2, rows, columns) with the means of their neighbours where they are wanted and NaN."""
    known = np.isfinite(values[0])
    share = ndimage.uniform_filter(known.astype(np.float64), 3)
    near = wanted & ~known & (share > 0.1)
    means = [ndimage.uniform_filter(np.where(known, one, 0.0), 3) for one in values]
    return np.where(near, np.stack(means) / np.where(near, share, 1.0), values)


def _by_first_image(
    inputs: Inputs,
    recording: Subject,
    scene: _Scene,
    partner: int,
    before: TexturedState,
    parameters: CorrelateParameters,
) -> _End:
    """Match a partner's later image with the first image of the reference camera."""
    surface = before.surface
    shape = surface.reason.shape
    measurement = inputs.read(PARTNERS, MEASURED, recording)
    last, noise = white_texture(measurement, parameters.smoothing_px, np.ones(shape, dtype=bool))
    images = prepare_images(
        before.texture,
        last,
        before.matched,
        (before.noise, noise),
        parameters.interpolation,
        spots=scene.spots[partner],
    )
    subsets = Subsets(surface.subset_radius_px, cast(ShapeOrder, surface.shape_order))
    spread = match_and_spread(
        images, scene.expected[partner], subsets, parameters, inputs.threads, between=True
    )
    off = asks_for_another_place(spread.bias, spread.variance)
    disagree = np.isfinite(spread.moved[0]) & (off | ~spread.agrees)
    place = np.where(disagree, np.nan, pixel_maps(*shape) + spread.moved)
    slopes = slopes_of_places(place, subsets.radius)
    slopes = np.where(np.isfinite(slopes), slopes, np.eye(2)[..., None, None])
    # What matches between cameras leave over is in their variance.
    return _End(FollowedPlaces(place, spread.variance, spread.noise, 0.0 * spread.bias, slopes), disagree)


def _met(
    scene: _Scene,
    moved: FollowedMatches,
    correlation: Floats,
    before: TexturedState,
    ends: list[FollowedPlaces],
    wanted: Mask,
    parameters: CorrelateParameters,
    threads: int,
) -> FollowedPoints:
    """Meet the rays of the wanted pixels (rows, columns) before and after."""
    surface, radius = before.surface, parameters.subset_radius_px
    pixels = pixel_maps(*wanted.shape)
    end = pixels + moved.moved
    slopes = slopes_of_places(end, radius)
    slopes = np.where(np.isfinite(slopes), slopes, np.eye(2)[..., None, None])
    own = FollowedPlaces(end, moved.variance, moved.noise, moved.bias, slopes)
    first_slopes = np.stack([slopes_of_places(one, surface.subset_radius_px) for one in scene.first])
    depth = trace(position_covariance(surface))
    part = np.zeros(wanted.shape) if surface.noise_part is None else surface.noise_part.astype(np.float64)
    rows, columns = np.nonzero(wanted)
    found = []
    for some in range(0, max(len(rows), 1), _AT_ONCE):
        at = rows[some : some + _AT_ONCE], columns[some : some + _AT_ONCE]
        start = StartPlaces(
            np.stack([one[:, *at] for one in scene.first]), first_slopes[..., *at], depth[at], part[at]
        )
        found.append(
            followed_displacement(
                scene.cameras,
                pixels[:, *at],
                start,
                own.at(*at),
                [one.at(*at) for one in ends],
                correlation[at],
                by_own_texture=parameters.following == "own-reference",
                threads=threads,
            )
        )
    return FollowedPoints(
        *(
            np.concatenate(values, axis=-1)
            for values in zip(*(vars(one).values() for one in found), strict=True)
        )
    )


def _told(field: DisplacementField, found: FollowedPoints, wanted: Mask, disagree: Mask) -> DisplacementField:
    """Return the field with what was found at the wanted pixels, and with reasons at the others."""
    reason, valid = field.reason.copy(), field.reason == Reason.VALID
    miss = np.full(reason.shape, np.nan)
    miss[wanted] = found.miss
    reason[valid & ~np.isfinite(miss)] = Reason.NO_MATCH
    reason[valid & ~np.isfinite(miss) & disagree] = Reason.IMAGES_DISAGREE
    known = np.isfinite(miss)
    if known.any():
        allowed = _MISS_SIGMAS**2 * max(1.0, float(np.median(miss[known])))
        reason[known & (miss > allowed)] = Reason.LARGE_RAY_GAP

    def everywhere(values: Floats) -> Floats:
        whole = np.full((len(values), *reason.shape), np.nan)
        whole[:, wanted] = values
        whole[:, reason != Reason.VALID] = np.nan
        return whole

    return replace(
        field,
        displacement=everywhere(found.displacement),
        covariance=everywhere(found.covariance).astype(np.float32),
        bias=everywhere(found.bias).astype(np.float32),
        image_displacement=np.where(reason == Reason.VALID, field.image_displacement, np.nan),
        reason=reason,
    )
