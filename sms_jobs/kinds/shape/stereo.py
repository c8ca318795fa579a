"""Stereo: from the images of two cameras or more to a point, its covariance and a reason for every pixel.

Points of a grid in the reference camera's image are found in each partner's by subsets, beginning at places
along the images of their rays, and from there from neighbour to neighbour. A match has to lead back to where
it came from and to lie where the calibration allows; what fails has a reason and no value. Matches are then
spread to the pixels and brought to points.

Subsets are of second order by default: between two cameras even a plane is seen with perspective, and the
curvature of a surface shows as curvature of the disparity, which those of first order take for a shift. On a
cylinder of 300 mm seen from 600 mm at 20 degrees that is 0.012 px, against 0.001 px.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.calibration_factors import calibration_factor, median_part, position_sigma
from sms_jobs.kinds.kind import (
    CALIBRATION,
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    camera_tuples,
)
from sms_jobs.kinds.point_matches import (
    match_statistics,
    matches_record,
    summary,
)
from sms_jobs.kinds.products import (
    CALIBRATED,
    CALIBRATION_FACTOR,
    MATCHES,
    MEASURED,
    PLACES,
    SURFACE,
    UNCERTAINTY,
    Product,
)
from sms_jobs.kinds.resolution import resolution_of_matches
from sms_jobs.kinds.shape.partner_places import (
    PartnerPlaces,
    held_against_the_images,
    places_of_pixels,
    places_seen,
    points_of_pixels,
    with_noise,
    with_shaken_rays,
)
from sms_jobs.kinds.shape.ray_images import (
    line_width,
    lines_summary,
    matches_missed,
    refuse_far_from_rays,
    refuse_parted_rays,
    stated_by,
    told_by_rays,
    why_nothing,
)
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.kinds.shape.textures import spots_of, white_texture
from sms_jobs.kinds.valid_parts import fractions, losses
from sms_jobs.metrology.deformation.matching.camera_matching import (
    RaySearch,
    TexturedCamera,
    distance_from_rays,
    match_cameras,
)
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    PreparedImages,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings
from sms_jobs.metrology.deformation.matching.sampling import Nodes, sample_nodes
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.geometry.camera import Camera
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.several_cameras import SeenPoints
from sms_jobs.metrology.images.masks import outside_box
from sms_jobs.metrology.images.texture_extent import textured_pixels
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import ImageMatches, Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration, Sensor
from sms_jobs.records.subject import Subject

_GAP_SIGMAS = 6.0
"""Largest gap of the rays, in units of what noise and calibration explain; noise alone never reaches it."""
_MOST_SATURATED = 0.5
"""Part of an image that may be saturated: a bright background may, a specimen and its surroundings not."""


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,), several=True)
_CALIBRATION = Port("calibration", CALIBRATION, (CALIBRATED, UNCERTAINTY))


def _needs(campaign: Campaign, subject: Subject, parameters: StereoParameters) -> Iterable[Need]:
    yield from map(_FRAMES.of, subject.recordings)
    yield _CALIBRATION.of(subject)


def run(inputs: Inputs, parameters: StereoParameters, progress: Progress) -> Iterator[Output]:
    """Match the reference camera's texture with that of every partner, and meet the rays."""
    calibration = inputs.read(_CALIBRATION, CALIBRATED)
    seen = [_seen(inputs, calibration, own, parameters) for own in inputs.subject.recordings]
    reference, partners = seen[0], seen[1:]
    labels = _specimen(reference, parameters)
    nodes = sample_nodes(labels, parameters.spacing_px)
    factor = calibration_factor(inputs, _CALIBRATION, calibration)
    found: list[GridMatches] = []
    spread: list[PartnerPlaces] = []
    for number, (name, partner) in enumerate(zip(inputs.view.other_cameras, partners, strict=True)):
        progress(
            0.8 * number / len(partners), f"matching {len(nodes.x)} points of {inputs.view.camera} in {name}"
        )
        volume = (calibration.volume.low, calibration.volume.high)
        search = RaySearch(volume, line_width(factor, number + 1, parameters.epipolar_width_px))
        noise, spots = (reference.noise, partner.noise), spots_of(parameters.smoothing_px)
        images = prepare_images(reference.texture, partner.texture, labels, noise, spots=spots)
        matched, images = _matched(inputs, name, reference, partner, images, nodes, parameters, search)
        found.append(matched)
        both = reference.camera, partner.camera
        spread.append(places_of_pixels(both, images, matched, parameters, inputs.threads))
    progress(0.8, "; ".join(summary(one.matches.ending) for one in found))
    epipolar = refuse_far_from_rays(
        inputs.view, [one.camera for one in seen], found, parameters.maximum_epipolar_px, inputs.threads
    )
    field = points_of_pixels(reference, partners, spread, parameters.subset_radius_px, inputs.threads)
    resolution = resolution_of_matches(
        parameters.subset_radius_px,
        cast(ShapeOrder, parameters.shape_order),
        found[0].matches.warp.shape[1],
        parameters.spacing_px,
    )
    surface = _surface(inputs, calibration, field, labels, found, parameters, epipolar, resolution)
    refuse_parted_rays(inputs.view, surface, field.freedom)
    surface = with_noise(surface, field, spread, parameters.shape_order)
    surface = with_shaken_rays(surface, reference.camera, spread)
    surface = held_against_the_images(surface, spread)
    kept = {
        name: matches_record(one, labels) for name, one in zip(inputs.view.other_cameras, found, strict=True)
    }
    statistics = _statistics(surface, labels, kept, epipolar)
    noise_px = statistics.get("median_match_sigma_px", 0.0)
    subset = (2 * parameters.subset_radius_px + 1) / parameters.spacing_px
    misses = matches_missed([one.camera for one in seen], found, max(1.0, subset**2), inputs.threads)
    factor = told_by_rays(factor, surface, epipolar, noise_px, misses)
    surface = replace(surface, sigma_calibration=position_sigma(factor, surface))
    statistics |= stated_by(factor) | median_part(surface.sigma_calibration, "mm")
    records: dict[Product[Any], object] = {SURFACE: surface, CALIBRATION_FACTOR: factor}
    records |= {MATCHES.of(name): matches for name, matches in kept.items()}
    for name, places in zip(inputs.view.other_cameras, spread, strict=True):
        records[PLACES.of(name)] = places_seen(name, places, surface)
    progress(1.0, lines_summary(factor, epipolar, noise_px))
    yield DatasetOutput(inputs.subject, records, statistics)


def _seen(
    inputs: Inputs, calibration: Calibration, recorded: Subject, parameters: StereoParameters
) -> TexturedCamera:
    """Return a camera of the view with its texture, filtered; `InvalidInput` where the two do not fit."""
    measurement: Measurement = inputs.read(_FRAMES, MEASURED, recorded)
    name = str(recorded.view)
    sensor = calibration.rig.sensor(name)
    rows, columns = measurement.texture.shape
    if (rows, columns) != (sensor.rows, sensor.columns):
        raise InvalidInput(
            f"the image of {recorded} has {columns} x {rows} px but {name} is calibrated for "
            f"{sensor.columns} x {sensor.rows} px: choose the calibration of the camera that recorded it"
        )
    reference = calibration.rig.sensor(inputs.view.camera)
    if (reference.rows, reference.columns) != (rows, columns):
        raise InvalidInput(
            f"{reference.name} and {name} have images of {reference.columns} x {reference.rows} px and "
            f"{columns} x {rows} px; the cameras of a view need images of one size: "
            "crop them alike and calibrate that"
        )
    texture, noise = white_texture(measurement, parameters.smoothing_px, np.ones((rows, columns), dtype=bool))
    saturated = float(np.mean(measurement.texture >= measurement.full_scale))
    if saturated > _MOST_SATURATED:
        raise InvalidInput(
            f"{saturated:.0%} of the image of {recorded} are saturated, at {measurement.full_scale} or "
            f"above; at most {_MOST_SATURATED:.0%} may be: record it with less light, or give its full scale"
        )
    if float(np.ptp(measurement.texture)) == 0.0:
        raise InvalidInput(f"the image of {recorded} is blank: every pixel is {measurement.texture.flat[0]}")
    return TexturedCamera(_camera(sensor), np.asarray(texture), noise)


def _camera(sensor: Sensor) -> Camera:
    return Camera(sensor.intrinsics, sensor.pose, sensor.columns, sensor.rows)


def _specimen(reference: TexturedCamera, parameters: StereoParameters) -> NDArray[np.int32]:
    """Return 1 where the reference image shows the specimen, (rows, columns)."""
    if not parameters.outline:
        return np.ones(reference.texture.shape, dtype=np.int32)
    level = reference.noise.floor + reference.noise.slope * reference.texture
    coarsest, margin = parameters.subset_radius_px, parameters.edge_margin_px
    return np.asarray(textured_pixels(reference.texture, level, coarsest, margin), dtype=np.int32)


def _matched(
    inputs: Inputs,
    name: str,
    reference: TexturedCamera,
    partner: TexturedCamera,
    images: PreparedImages,
    nodes: Nodes,
    parameters: StereoParameters,
    search: RaySearch,
) -> tuple[GridMatches, PreparedImages]:
    """Match the points with a partner; raise `MeasurementFailed` where nothing of them is found."""
    found, images = match_cameras(
        reference,
        partner,
        images,
        nodes,
        MatchSettings(
            parameters.subset_radius_px,
            parameters.minimum_subset_part,
            tolerance=parameters.convergence_px,
            shape_order=cast(ShapeOrder, parameters.shape_order),
        ),
        GridSettings(
            parameters.spacing_px,
            minimum_score=parameters.minimum_score,
            maximum_sigma=parameters.maximum_sigma_px,
        ),
        search,
        inputs.threads,
    )
    if not len(nodes.x):
        raise MeasurementFailed(f"the image of {inputs.subject.recordings[0]} shows no texture to be matched")
    if not (found.matches.ending == CONVERGED).any():
        seen = partial(distance_from_rays, labels=images.labels, nodes=nodes, volume=search.volume)
        off = seen(reference, partner, threads=inputs.threads)
        other = replace(reference, camera=partner.camera), replace(partner, camera=reference.camera)
        swapped = name, seen(*other, threads=inputs.threads)
        raise MeasurementFailed(why_nothing(inputs.view, off, swapped))
    return found, images


def _surface(
    inputs: Inputs,
    calibration: Calibration,
    met: SeenPoints,
    labels: NDArray[np.int32],
    found: list[GridMatches],
    parameters: StereoParameters,
    epipolar_px: float,
    resolution_px: float,
) -> Surface:
    """Return the points as a surface, NaN where there is a reason."""
    shape = labels.shape
    position, covariance = met.xyz.reshape(3, *shape), met.covariance.reshape(6, *shape).astype(np.float32)
    gap = met.ray_gap.reshape(shape).astype(np.float32)
    reason = np.zeros(shape, dtype=np.uint32)
    missing = np.isnan(position[0]) | ~np.isfinite(covariance).all(axis=0)
    reason[missing] = Reason.NO_MATCH
    reason[labels == 0] = Reason.NO_TEXTURE
    reason[~missing & outside_box(position, calibration.volume.low, calibration.volume.high)] |= np.uint32(
        Reason.OUT_OF_VOLUME
    )
    # What the calibration is wrong by for all of them is no reason to doubt one.
    typical = np.concatenate([one.matches.sigma[one.matches.ending == CONVERGED].ravel() for one in found])
    allowed = _GAP_SIGMAS**2 * (1.0 + (epipolar_px / float(np.median(typical))) ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = (met.chi_square / met.freedom > allowed).reshape(shape)
    reason[~missing & apart] |= np.uint32(Reason.LARGE_RAY_GAP)
    bad = reason != Reason.VALID
    for values in (position, covariance, gap[None]):
        np.copyto(values, np.nan, where=bad)
    return Surface(
        str(inputs.view),
        "mm",
        position,
        reason,
        covariance,
        gap,
        subset_radius_px=parameters.subset_radius_px,
        resolution_px=resolution_px,
    )


def _statistics(
    surface: Surface, labels: NDArray[np.int32], matches: Mapping[str, ImageMatches], epipolar_px: float
) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = surface.reason == Reason.VALID
    each = [match_statistics(one) for one in matches.values()]
    statistics = {
        **fractions(valid, labels > 0),
        **losses(surface.reason),
        **{name: float(np.mean([one[name] for one in each if name in one])) for name in each[0]},
        "epipolar_rms_px": epipolar_px,
    }
    if valid.any() and surface.covariance is not None and surface.ray_gap is not None:
        sigma = np.sqrt(trace(surface.covariance)[valid])
        gap = surface.ray_gap[valid].astype(np.float64)
        statistics |= {
            "median_sigma_mm": float(np.median(sigma)),
            "ray_gap_rms_mm": float(np.sqrt(np.mean(gap**2))),
        }
    return statistics


KIND = Kind(
    name="stereo",
    summary="shape from the images of several cameras: textures matched between them, rays met",
    version=28,
    scope=Scope.TUPLE,
    parameters=StereoParameters,
    inputs=(_FRAMES, _CALIBRATION),
    outputs=(SURFACE, MATCHES.by("camera"), PLACES.by("camera"), CALIBRATION_FACTOR),
    needs=_needs,
    run=run,
    subjects=camera_tuples,
)
