"""Correlate images: displacement in one camera's image from textures alone, for flat specimens."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.correlate_parameters import MatchingParameters
from sms_jobs.kinds.kind import (
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_images,
    deformed_images_alone,
)
from sms_jobs.kinds.planes import pixel_plane
from sms_jobs.kinds.point_matches import (
    match_settings,
    match_statistics,
    matches_record,
    search_settings,
    summary,
    trusted_points,
)
from sms_jobs.kinds.products import MATCHES, MEASURED, PLANAR_DISPLACEMENT
from sms_jobs.kinds.valid_parts import fractions, textured
from sms_jobs.metrology.deformation.correlation import Noise, prepare_images
from sms_jobs.metrology.deformation.displacement import BLEND_RADII, blend_matches
from sms_jobs.metrology.deformation.matching import GridMatches, GridSettings, match_grid
from sms_jobs.metrology.images.region_of_interest import inside_outlines, parse_outlines
from sms_jobs.metrology.images.smoothing import noise_after_smoothing, smooth
from sms_jobs.metrology.images.texture_extent import textured_pixels
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import ImageMatches
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.planar import PlanarDisplacement
from sms_jobs.records.reasons import Reason


class CorrelateImagesParameters(MatchingParameters):
    """How textures are matched, where, and how large a pixel is."""

    mm_per_px: float | None = Field(
        None, gt=0.0, description="size of a pixel on the specimen; without it results are in pixels alone"
    )
    outline: Literal["texture", "none"] = Field(
        "texture",
        description="whether the specimen ends where its texture ends, so that no subset looks at the "
        "background or into a hole; none takes the whole image or region of interest",
    )


_REFERENCE = Port("reference", MEASUREMENT, (MEASURED,))
_DEFORMED = Port("measurement", MEASUREMENT, (MEASURED,))


def _needs(campaign: Campaign, subject: Subject, parameters: CorrelateImagesParameters) -> Iterable[Need]:
    yield _REFERENCE.of(replace(subject, state=campaign.reference.label))
    yield _DEFORMED.of(subject)


def _reference_label(campaign: Campaign, subject: Subject) -> str:
    return campaign.reference.label


def run(inputs: Inputs, parameters: CorrelateImagesParameters, progress: Progress) -> Iterator[Output]:
    """Match the white frames of two states and spread the matches over the image."""
    before, after = (inputs.read(port, MEASURED) for port in (_REFERENCE, _DEFORMED))
    shape = before.texture.shape
    if after.texture.shape != shape:
        raise InvalidInput(
            f"the image of {inputs.subject} has {after.texture.shape[1]} x {after.texture.shape[0]} px, that "
            f"of the reference state {shape[1]} x {shape[0]} px; record both with one camera"
        )
    inside = np.ones(shape, dtype=bool)
    if parameters.region_of_interest:
        inside = inside_outlines(parse_outlines(parameters.region_of_interest), shape)
    if not inside.any():
        raise InvalidInput(
            f"the region of interest '{parameters.region_of_interest}' leaves no pixel of {inputs.subject}, "
            f"whose image has {shape[1]} x {shape[0]} px; give outlines that lie in it"
        )
    images = [_texture(m, inside, parameters) for m in (before, after)]
    plain = np.zeros(shape, dtype=bool)
    if parameters.outline == "texture":
        level, noise = images[0]
        plain = ~textured_pixels(level, noise.floor + noise.slope * level, parameters.subset_radius_px)
    labels = (inside & ~plain).astype(np.int32)
    progress(0.1, f"{np.count_nonzero(labels)} of {labels.size} pixels show the specimen")
    grid = _matched(images, labels, parameters, inputs.threads)
    progress(0.8, summary(grid.matches.ending))
    matches = matches_record(grid, labels)
    value, variance = blend_matches(
        trusted_points(grid, labels),
        pixel_plane(shape),
        labels,
        BLEND_RADII * parameters.subset_radius_px,
        inputs.threads,
    )
    near = _near_a_match(matches, shape, parameters.spacing_px)
    reason = _reasons(np.isnan(value[0]) | ~near, inside, plain, matches)
    value[:, reason != 0] = np.nan
    variance[:, reason != 0] = np.nan
    scale = parameters.mm_per_px
    field = PlanarDisplacement(
        inputs.view.camera,
        inputs.context,
        parameters.subset_radius_px,
        scale,
        value,
        np.sqrt(variance).astype(np.float32),
        reason,
        None if scale is None else value * scale,
    )
    progress(1.0, "spread the matches")
    yield DatasetOutput(
        inputs.subject, {PLANAR_DISPLACEMENT: field, MATCHES: matches}, _statistics(field, matches)
    )


def _texture(
    measurement: Measurement, inside: NDArray[np.bool_], parameters: CorrelateImagesParameters
) -> tuple[NDArray[np.float64], Noise]:
    """Return the smoothed white frame and its noise."""
    texture = smooth(measurement.texture.astype(np.float64), parameters.smoothing_px)
    factor = noise_after_smoothing(texture, inside, parameters.smoothing_px)
    return texture, Noise(factor * measurement.read_noise**2, factor * measurement.gain)


def _matched(
    images: Sequence[tuple[NDArray[np.float64], Noise]],
    labels: NDArray[np.int32],
    parameters: CorrelateImagesParameters,
    threads: int,
) -> GridMatches:
    """Match the points of a grid."""
    (before, noise), (after, noise_after) = images
    return match_grid(
        prepare_images(before, after, labels, (noise, noise_after), parameters.interpolation),
        after,
        match_settings(parameters),
        GridSettings(
            parameters.spacing_px,
            minimum_score=parameters.minimum_score,
            maximum_sigma=parameters.maximum_sigma_px,
        ),
        search_settings(parameters),
        threads,
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


def _reasons(
    missing: NDArray[np.bool_],
    inside: NDArray[np.bool_],
    plain: NDArray[np.bool_],
    matches: ImageMatches,
) -> NDArray[np.uint32]:
    """Return why pixels have no value: what the nearest point has against it, or that none is near."""
    reason = np.zeros(inside.shape, dtype=np.uint32)
    lost = matches.reason != 0
    lacking = missing & inside
    if lost.any() and lacking.any():
        points = cKDTree(np.stack([matches.x[lost], matches.y[lost]], axis=1))
        row, column = np.nonzero(lacking)
        _, nearest = points.query(np.stack([column, row], axis=1))
        reason[lacking] = matches.reason[lost][nearest]
    reason[lacking & (reason == 0)] = Reason.NO_MATCH
    reason[plain] = Reason.NO_TEXTURE
    reason[~inside] = Reason.OUTSIDE_REGION
    return reason


def _statistics(field: PlanarDisplacement, matches: ImageMatches) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = field.reason == Reason.VALID
    statistics = {**fractions(valid, textured(field.reason)), **match_statistics(matches)}
    if valid.any():
        length = np.hypot(*field.displacement[:, valid])
        statistics |= {
            "median_displacement_px": float(np.median(length)),
            "maximum_displacement_px": float(length.max()),
            "median_sigma_px": float(np.median(np.hypot(*field.sigma[:, valid]))),
        }
        if field.mm_per_px is not None:
            statistics["median_displacement_mm"] = field.mm_per_px * statistics["median_displacement_px"]
            statistics["maximum_displacement_mm"] = field.mm_per_px * statistics["maximum_displacement_px"]
    return statistics


KIND = Kind(
    name="correlate-images",
    summary="displacement in the image from textures alone: one camera, a flat specimen, no fringes",
    version=3,
    scope=Scope.TUPLE,
    parameters=CorrelateImagesParameters,
    inputs=(_REFERENCE, _DEFORMED),
    outputs=(PLANAR_DISPLACEMENT, MATCHES),
    needs=_needs,
    run=run,
    subjects=deformed_images,
    pipeline_subjects=deformed_images_alone,
    context=_reference_label,
)
