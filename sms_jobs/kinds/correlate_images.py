"""Correlate images: displacement in one camera's image from textures alone, for flat specimens."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import cast

import numpy as np
from pydantic import Field, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import (
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Progress,
    Scope,
    deformed_tuples,
)
from sms_jobs.metrology.deformation import correlation
from sms_jobs.metrology.deformation.correlation import MatchSettings, Noise, prepare_images
from sms_jobs.metrology.deformation.displacement import BLEND_RADII, ImagePoints, blend_matches
from sms_jobs.metrology.deformation.matching import GridSettings, match_grid
from sms_jobs.metrology.deformation.seeding import SearchSettings
from sms_jobs.metrology.deformation.shape_functions import ShapeOrder
from sms_jobs.metrology.images.region_of_interest import inside_outlines, parse_outlines
from sms_jobs.metrology.images.smoothing import LARGEST_SMOOTHING_PX, noise_after_smoothing, smooth
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.planar import PlanarDisplacement
from sms_jobs.records.reasons import Reason


class CorrelateImagesParameters(Parameters):
    """How textures are matched, where, and how large a pixel is."""

    mm_per_px: float | None = Field(
        None, gt=0.0, description="size of a pixel on the specimen; without it results are in pixels alone"
    )
    region_of_interest: str = Field(
        "", description="outlines in px, as 'sms data outline' prints them; the whole image by default"
    )
    smoothing_px: float = Field(
        0.6,
        ge=0.0,
        le=LARGEST_SMOOTHING_PX,
        description="standard deviation of the filter that both textures pass before they are matched",
    )
    subset_radius_px: int = Field(10, ge=3, le=100, description="a subset has (2 radius + 1)^2 pixels")
    shape_order: int = Field(
        1, ge=0, le=2, description="how a subset may deform: 0 shift, 1 affine, 2 quadratic"
    )
    spacing_px: int = Field(4, ge=1, le=100, description="distance of the matched points")
    minimum_score: float = Field(
        0.8, gt=0.0, lt=1.0, description="least zero-normalised cross-correlation of a match"
    )
    maximum_sigma_px: float = Field(0.05, gt=0.0, description="largest standard deviation of a match")
    search_range_x_px: int = Field(
        40, ge=1, le=1000, description="largest displacement along the columns that seeds look for"
    )
    search_range_y_px: int = Field(
        40, ge=1, le=1000, description="largest displacement along the rows that seeds look for"
    )

    @field_validator("region_of_interest")
    @classmethod
    def _outlines(cls, text: str) -> str:
        if text:
            parse_outlines(text)
        return text


def _needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    reference = Subject(subject.campaign, campaign.reference.label, subject.pair)
    yield Need("reference", MEASUREMENT, reference)
    yield Need("measurement", MEASUREMENT, subject)


def _reference_label(campaign: Campaign, subject: Subject) -> str:
    return campaign.reference.label


def run(inputs: Inputs, parameters: CorrelateImagesParameters, progress: Progress) -> Iterator[Output]:
    """Match the white frames of two states and spread the matches over the image."""
    before, after = (inputs.read(role, "measurement", Measurement) for role in ("reference", "measurement"))
    shape = before.texture.shape
    if after.texture.shape != shape:
        raise InvalidInput(
            f"the image of {inputs.subject} has {after.texture.shape[1]} x {after.texture.shape[0]} px, that "
            f"of the reference state {shape[1]} x {shape[0]} px; record both with one camera"
        )
    inside = np.ones(shape, dtype=bool)
    if parameters.region_of_interest:
        inside = inside_outlines(parse_outlines(parameters.region_of_interest), shape)
    labels = inside.astype(np.int32)
    textures = [smooth(m.texture.astype(np.float64), parameters.smoothing_px) for m in (before, after)]
    noises = []
    for measurement, texture in zip((before, after), textures, strict=True):
        factor = noise_after_smoothing(texture, inside, parameters.smoothing_px)
        noises.append(Noise(factor * measurement.read_noise**2, factor * measurement.gain))
    progress(0.1, "prepared the textures")
    grid = match_grid(
        prepare_images(textures[0], textures[1], labels, (noises[0], noises[1])),
        textures[1],
        MatchSettings(parameters.subset_radius_px, shape_order=cast(ShapeOrder, parameters.shape_order)),
        GridSettings(
            parameters.spacing_px,
            minimum_score=parameters.minimum_score,
            maximum_sigma=parameters.maximum_sigma_px,
        ),
        SearchSettings(parameters.search_range_x_px, parameters.search_range_y_px),
        inputs.threads,
    )
    matched = grid.matches.ending == correlation.CONVERGED
    progress(0.8, f"matched {matched.sum()} of {len(grid.x)} points")
    points = ImagePoints(
        grid.x[matched],
        grid.y[matched],
        labels[grid.y[matched], grid.x[matched]],
        np.ascontiguousarray(grid.matches.warp[matched, :6]),
        grid.matches.sigma[matched],
    )
    value, variance = blend_matches(
        points, pixel_plane(shape), labels, BLEND_RADII * parameters.subset_radius_px, inputs.threads
    )
    reason = np.zeros(shape, dtype=np.uint32)
    reason[np.isnan(value[0])] = Reason.NO_MATCH
    reason[~inside] = Reason.OUTSIDE_REGION
    value[:, reason != 0] = np.nan
    variance[:, reason != 0] = np.nan
    scale = parameters.mm_per_px
    field = PlanarDisplacement(
        (inputs.subject.pair or "").partition("P")[0],  # a camera alone is no pair
        inputs.context,
        parameters.subset_radius_px,
        scale,
        value,
        np.sqrt(variance).astype(np.float32),
        reason,
        None if scale is None else value * scale,
    )
    progress(1.0, "spread the matches")
    yield DatasetOutput(inputs.subject, {"displacement": field}, _statistics(field, matched))


def pixel_plane(shape: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the pixels as points of a plane, (3, rows, columns): x to the right, y up, in px."""
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    return np.stack([column, -row, np.zeros(shape)])


def _statistics(
    field: PlanarDisplacement, matched: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> dict[str, float]:
    valid = field.reason == Reason.VALID
    statistics = {
        "valid_fraction": float(valid.mean()),
        "matched_fraction": float(matched.sum() / max(len(matched), 1)),
    }
    if valid.any():
        length = np.hypot(*field.displacement[:, valid])
        statistics |= {
            "median_displacement_px": float(np.median(length)),
            "maximum_displacement_px": float(length.max()),
            "median_sigma_px": float(np.median(np.hypot(*field.sigma[:, valid]))),
        }
    return statistics


KIND = Kind(
    name="correlate-images",
    summary="displacement in the image from textures alone: one camera, a flat specimen, no fringes",
    version=1,
    scope=Scope.TUPLE,
    parameters=CorrelateImagesParameters,
    needs=_needs,
    run=run,
    subjects=deformed_tuples,
    context=_reference_label,
    in_pipeline=False,
)
