"""Correlate: from two states of a pair to the displacement of every point seen in the reference image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, Self, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator
from scipy import ndimage

from sms_jobs.kinds.kind import (
    CALIBRATION,
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
from sms_jobs.metrology.deformation import correlation, displacement
from sms_jobs.metrology.deformation.correlation import MatchSettings, Noise, prepare_images
from sms_jobs.metrology.deformation.displacement import DenseDisplacement, ImagePoints, displacement_field
from sms_jobs.metrology.deformation.matching import GridMatches, GridSettings, Method, match_grid
from sms_jobs.metrology.deformation.seeding import SearchSettings
from sms_jobs.metrology.deformation.shape_functions import ShapeOrder
from sms_jobs.metrology.images.region_of_interest import inside_outlines, parse_outlines
from sms_jobs.metrology.images.segmentation import ContinuousRegions, label_regions, pixel_footprint
from sms_jobs.metrology.images.spline import Interpolant
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import (
    DisplacementField,
    ImageMatches,
    PhaseMaps,
    PointCloud,
    Region,
    Regions,
)
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration, Sensor, split_pair

Floats: TypeAlias = NDArray[np.float64]

_MATCH_REASONS = {
    correlation.CONVERGED: Reason.VALID,
    correlation.TOO_FEW_PIXELS: Reason.OUTSIDE_REGION,
    correlation.NO_TEXTURE: Reason.NO_TEXTURE,
    correlation.LEFT_IMAGE: Reason.LEFT_IMAGE,
    correlation.NOT_CONVERGED: Reason.NO_MATCH,
}
_PIXEL_REASONS = {
    displacement.OUTSIDE_REGION: Reason.OUTSIDE_REGION,
    displacement.NO_MATCH_NEAR: Reason.NO_MATCH,
    displacement.LEFT_IMAGE: Reason.LEFT_IMAGE,
    displacement.NO_SHAPE_AT_END: Reason.NO_SHAPE_AT_END,
}


class CorrelateParameters(Parameters):
    """How textures are matched and where."""

    texture: Literal["white", "fringe-average"] = Field(
        "fringe-average",
        description="image that is matched: the white frame, or the mean of all fringe frames, in which the "
        "fringes cancel and the camera's noise is lower by the square root of their number",
    )
    method: Method = Field(
        "gauss-newton",
        description="how a point is matched: by subsets that deform or, to compare with, by the peak of the "
        "thesis's cross-correlation (fourier-newton), a shift that is pulled towards whole pixels by up to a "
        "fifth of one and so asks for a maximum-sigma-px of about 0.3",
    )
    regions: Literal["measured", "none"] = Field(
        "measured",
        description="whether subsets end at the discontinuities of the measured shape, or, as in plain image "
        "correlation, know none: then they hold whatever is in their square",
    )
    subset_radius_px: int = Field(
        10, ge=3, le=100, description="a subset has (2 radius + 1)^2 pixels, less those of other regions"
    )
    shape_order: int = Field(
        1,
        ge=0,
        le=2,
        description="how a subset may deform: 0 shift, 1 affine, 2 quadratic, which follows curved fields "
        "and is noisier",
    )
    interpolation: Interpolant = Field(
        "quintic",
        description="B-spline between the pixels: the quintic has several times less bias than the cubic, "
        "and the local cubic, through 4 x 4 pixels alone, is there to compare with other programs",
    )
    spacing_px: int = Field(4, ge=1, le=100, description="distance of the matched points")
    edge_spacing_px: int | None = Field(
        None,
        ge=1,
        description="distance of the matched points within spacing-px of a region's edge; it must divide "
        "spacing-px and be at least a quarter of it; as elsewhere when not given",
    )
    region_of_interest: str = Field(
        "",
        description="the part of the reference image that is matched, in camera px, all when empty: "
        "'rectangle LEFT TOP RIGHT BOTTOM', 'polygon X Y X Y X Y ..', several in a row, '-' before what is "
        "left out; 'sms data outline' makes it of a mask image",
    )
    minimum_score: float = Field(
        0.8, gt=0.0, lt=1.0, description="least zero-normalised cross-correlation of a match"
    )
    maximum_sigma_px: float = Field(
        0.05, gt=0.0, description="largest standard deviation of a match, from noise and from its residual"
    )
    minimum_subset_part: float = Field(
        0.2, gt=0.0, le=1.0, description="least part of a subset that lies on its point's region"
    )
    search_range_x_px: int = Field(
        40, ge=1, le=1000, description="largest displacement along the columns that seeds look for"
    )
    search_range_y_px: int = Field(
        40, ge=1, le=1000, description="largest displacement along the rows that seeds look for"
    )
    edge_margin_px: int = Field(
        1, ge=0, le=20, description="rim of a region that is not matched: it mixes with what lies behind"
    )
    averaging_radius_px: float = Field(
        4.0,
        ge=1.5,
        le=50.0,
        description="radius within which displacement is averaged over a region's pixels",
    )
    minimum_region_area_px: int = Field(
        200, ge=1, description="smaller pieces of continuous surface are left out"
    )

    @field_validator("region_of_interest", mode="before")
    @classmethod
    def _outlines_can_be_read(cls, given: object) -> object:
        """Join what commas have parted, and refuse what is no region."""
        text = " ".join(map(str, given)) if isinstance(given, list | tuple) else given
        if isinstance(text, str) and text:
            parse_outlines(text)
        return text

    @model_validator(mode="after")
    def _spacings_fit(self) -> Self:
        if self.edge_spacing_px is not None and (
            self.spacing_px % self.edge_spacing_px or self.spacing_px > 4 * self.edge_spacing_px
        ):
            raise ValueError(
                f"edge_spacing_px = {self.edge_spacing_px} must divide spacing_px = {self.spacing_px} px and "
                "be at least a quarter of it"
            )
        return self


@dataclass(frozen=True)
class _State:
    """One state of the pair: texture, the texture's noise, shape, regions, and which pixels may be in one."""

    texture: NDArray[np.floating]
    noise: Noise
    cloud: PointCloud
    regions: ContinuousRegions
    of_interest: NDArray[np.bool_]


def _needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    reference = Subject(subject.campaign, campaign.reference.label, subject.pair)
    yield Need("calibration", CALIBRATION, subject)
    yield Need("reference_measurement", MEASUREMENT, reference)
    yield Need("measurement", MEASUREMENT, subject)
    yield Need("reference", "reconstruct", reference)
    yield Need("deformed", "reconstruct", subject)


def _reference_label(campaign: Campaign, subject: Subject) -> str:
    return campaign.reference.label


def run(inputs: Inputs, parameters: CorrelateParameters, progress: Progress) -> Iterator[Output]:
    """Match the textures region by region and look the displacement up in both states' shapes."""
    camera, _ = split_pair(inputs.subject.pair or "")
    sensor = inputs.read("calibration", "calibration", Calibration).rig.sensor(camera)
    before = _state(inputs, "reference", "reference_measurement", sensor, parameters, of_interest=True)
    after = _state(inputs, "deformed", "measurement", sensor, parameters, of_interest=False)
    interior = _interior(before.regions.labels, parameters)
    labels = _matched_labels(before, interior, parameters)
    progress(0.2, f"{len(before.regions.areas)} regions in the reference state")
    grid = match_grid(
        prepare_images(
            before.texture,
            after.texture,
            labels,
            (before.noise, after.noise),
            parameters.interpolation,
        ),
        after.texture,
        MatchSettings(
            parameters.subset_radius_px,
            parameters.minimum_subset_part,
            shape_order=cast(ShapeOrder, parameters.shape_order),
        ),
        GridSettings(
            parameters.spacing_px,
            parameters.edge_spacing_px,
            parameters.minimum_score,
            parameters.maximum_sigma_px,
            method=parameters.method,
        ),
        SearchSettings(parameters.search_range_x_px, parameters.search_range_y_px),
        inputs.threads,
    )
    matched = grid.matches.ending == correlation.CONVERGED
    progress(0.7, f"matched {matched.sum()} of {len(grid.x)} points")
    found = displacement_field(
        ImagePoints(
            grid.x[matched],
            grid.y[matched],
            before.regions.labels[grid.y[matched], grid.x[matched]],
            np.ascontiguousarray(grid.matches.warp[matched, :6]),
            grid.matches.sigma[matched],
        ),
        (before.cloud.xyz, before.cloud.covariance, before.regions.labels),
        (after.cloud.xyz, after.cloud.covariance, after.regions.labels),
        interior,
        subset_radius=parameters.subset_radius_px,
        averaging_radius=parameters.averaging_radius_px,
        threads=inputs.threads,
    )
    field = _displacement_record(found, before, inputs.context, parameters)
    matches = _matches_record(grid, before.regions)
    progress(1.0, "looked up the displacement")
    yield DatasetOutput(
        inputs.subject,
        {"displacement": field, "matches": matches, "regions": _regions_record(before.regions)},
        _statistics(field, matches, before),
    )


def _interior(labels: NDArray[np.int32], parameters: CorrelateParameters) -> NDArray[np.bool_]:
    """Return which pixels have their region all round them, up to the edge margin, if there are regions."""
    if parameters.regions == "none":
        return np.asarray(labels > 0)
    size = 2 * parameters.edge_margin_px + 1
    same = ndimage.minimum_filter(labels, size) == ndimage.maximum_filter(labels, size)
    return np.asarray(same & (labels > 0))


def _matched_labels(
    before: _State, interior: NDArray[np.bool_], parameters: CorrelateParameters
) -> NDArray[np.int32]:
    """Return which pixels are matched together: those of a region, or, without regions, all of interest."""
    if parameters.regions == "none":
        return before.of_interest.astype(np.int32)
    return np.where(interior, before.regions.labels, 0).astype(np.int32)


def _state(
    inputs: Inputs,
    shape_role: str,
    frames_role: str,
    sensor: Sensor,
    parameters: CorrelateParameters,
    *,
    of_interest: bool,
) -> _State:
    """Read one state, choose its texture and find its regions, all or those of interest."""
    measurement = inputs.read(frames_role, "measurement", Measurement)
    cloud = inputs.read(shape_role, "cloud", PointCloud)
    if parameters.texture == "white":
        texture: NDArray[np.floating] = measurement.texture.astype(np.float64)
        noise = Noise(measurement.read_noise**2, measurement.gain)
    else:
        phase = inputs.read(shape_role, "phase", PhaseMaps)
        texture = phase.mean_intensity
        noise = average_noise(measurement, phase, cloud.reason == Reason.VALID)
    chosen = np.ones(cloud.reason.shape, dtype=bool)
    if of_interest and parameters.region_of_interest:
        chosen = inside_outlines(parse_outlines(parameters.region_of_interest), cloud.reason.shape)
    valid = (cloud.reason == Reason.VALID) & chosen
    if parameters.regions == "none":
        return _State(texture, noise, cloud, _one_region(valid), chosen)
    regions = label_regions(
        cloud.xyz,
        valid,
        np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0, dtype=np.float64)),
        pixel_footprint(cloud.xyz, sensor.intrinsics, sensor.pose),
        minimum_area=parameters.minimum_region_area_px,
        threads=inputs.threads,
    )
    return _State(texture, noise, cloud, regions, chosen)


def _one_region(valid: NDArray[np.bool_]) -> ContinuousRegions:
    """Return all that has a shape as a single region."""
    if not valid.any():
        return ContinuousRegions(np.zeros(valid.shape, np.int32), np.zeros(0, np.int64), np.zeros((0, 2)))
    y, x = np.nonzero(valid)
    centroid = np.array([[x.mean(), y.mean()]])
    return ContinuousRegions(valid.astype(np.int32), np.array([valid.sum()]), centroid)


def average_noise(measurement: Measurement, phase: PhaseMaps, valid: NDArray[np.bool_]) -> Noise:
    """Return the noise of the mean over the fringe frames, whose grey levels are those at exposure 1.

    Where pixels have exposures of their own it is right for the valid ones together: too much for the dark
    ones and too little for a highlight, which has the short exposures.
    """
    frames = measurement.sequence.frames_per_exposure
    read_variance, gain = measurement.read_noise**2 / frames, measurement.gain / frames
    if phase.exposure is None or not valid.any():
        return Noise(read_variance, gain)
    scale = 1.0 / phase.exposure[valid].astype(np.float64)
    level = phase.mean_intensity[valid]
    slope = float(np.mean(scale * level) / np.mean(level, dtype=np.float64))
    return Noise(read_variance * float(np.mean(scale**2)), gain * slope)


def _displacement_record(
    found: DenseDisplacement, before: _State, reference: str, parameters: CorrelateParameters
) -> DisplacementField:
    reason = before.cloud.reason.copy()
    for status, why in _PIXEL_REASONS.items():
        reason[(found.status == status) & (reason == Reason.VALID)] = np.uint32(why)
    return DisplacementField(
        before.cloud.camera,
        before.cloud.projector,
        reference,
        found.displacement,
        found.covariance.astype(np.float32),
        found.image_displacement,
        reason,
        parameters.averaging_radius_px,
        parameters.subset_radius_px,
    )


def _matches_record(grid: GridMatches, regions: ContinuousRegions) -> ImageMatches:
    """Return the matches, NaN where there is a reason; the score is kept, since it may be that reason."""
    found = grid.matches
    reason = np.zeros(len(grid.x), dtype=np.uint32)
    for ending, why in _MATCH_REASONS.items():
        reason[found.ending == ending] = np.uint32(why)
    warp, sigma = found.warp.T.copy(), found.sigma.T.astype(np.float32)
    warp[:, reason != 0] = np.nan
    sigma[:, reason != 0] = np.nan
    return ImageMatches(
        x=grid.x.astype(np.float64),
        y=grid.y.astype(np.float64),
        region=regions.labels[grid.y, grid.x],
        u=warp[0],
        v=warp[3],
        gradient=warp[[1, 2, 4, 5]],
        sigma_u=sigma[0],
        sigma_v=sigma[1],
        score=found.score.astype(np.float32),
        iterations=found.iterations,
        reason=reason,
    )


def _regions_record(regions: ContinuousRegions) -> Regions:
    each = zip(regions.areas, regions.centroids, strict=True)
    described = tuple(
        Region(number, int(area), (float(x), float(y))) for number, (area, (x, y)) in enumerate(each, start=1)
    )
    return Regions(described, regions.labels)


def _statistics(field: DisplacementField, matches: ImageMatches, before: _State) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = field.reason == Reason.VALID
    measured = before.cloud.reason == Reason.VALID
    matched = matches.reason == Reason.VALID
    statistics = {
        "valid_fraction": float(valid.mean()),
        "valid_fraction_of_shape": float(valid.sum() / max(measured.sum(), 1)),
        "matched_fraction": float(matched.sum() / max(len(matched), 1)),
        "regions": float(len(before.regions.areas)),
    }
    if valid.any():
        sigma = np.sqrt(field.covariance[[0, 3, 5]][:, valid].sum(axis=0))
        length = np.linalg.norm(field.displacement[:, valid], axis=0)
        statistics |= {
            "median_sigma_mm": float(np.median(sigma)),
            "median_displacement_mm": float(np.median(length)),
            "maximum_displacement_mm": float(length.max()),
            "mean_score": float(matches.score[matched].mean()),
            "median_match_sigma_px": float(np.median(np.hypot(matches.sigma_u, matches.sigma_v)[matched])),
        }
    return statistics


KIND = Kind(
    name="correlate",
    summary="displacement from two states: texture matched region by region, looked up in both shapes",
    version=3,
    scope=Scope.TUPLE,
    parameters=CorrelateParameters,
    needs=_needs,
    run=run,
    subjects=deformed_tuples,
    context=_reference_label,
)
