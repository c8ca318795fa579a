"""What can be chosen about matching textures."""

from __future__ import annotations

from typing import Literal, Self, TypeAlias, cast

from pydantic import Field, field_validator, model_validator

from sms_jobs.kinds.parameters import Parameters
from sms_jobs.metrology.deformation.matching.correlation import MatchSettings
from sms_jobs.metrology.deformation.matching.grid import Method
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.images.region_of_interest import parse_outlines
from sms_jobs.metrology.images.segmentation import EdgeSettings, EdgeTest
from sms_jobs.metrology.images.smoothing import LARGEST_SMOOTHING_PX
from sms_jobs.metrology.images.spline import Interpolant

Following: TypeAlias = Literal["each-state", "own-reference", "shared-reference"]
"""How points are followed that several cameras see."""

_USUAL_EDGES = EdgeSettings()


class CorrelateParameters(Parameters):
    """How textures are matched and where."""

    region_of_interest: str = Field(
        "",
        description="the part of the reference image that is matched, in camera px, all when empty: "
        "'rectangle LEFT TOP RIGHT BOTTOM', 'polygon X Y X Y X Y ..', several in a row, '-' before what is "
        "left out; 'sms data outline' makes it of a mask image",
    )
    smoothing_px: float = Field(
        0.6,
        ge=0.0,
        le=LARGEST_SMOOTHING_PX,
        description="standard deviation of the filter that both textures pass before they are matched: it "
        "takes out what is too fine for the pixels, which does not move as the specimen does; 0 for none",
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
    subsets: Literal["fixed", "adaptive"] = Field(
        "fixed",
        description="adaptive matches again, with the second order and then with smaller subsets, where the "
        "images ask for more than the noise that this adds, and takes at each pixel what has the smaller "
        "error; where nothing bends it changes nothing",
    )
    interpolation: Interpolant = Field(
        "quintic",
        description="B-spline between the pixels: the quintic has several times less bias than the cubic, "
        "and the local cubic, through 4 x 4 pixels alone, is there to compare with other programs",
    )
    convergence_px: float = Field(
        5e-4,
        gt=0.0,
        le=0.1,
        description="rms movement of a subset's pixels at which its iteration ends; 1e-5 costs one "
        "iteration more, and is for comparisons with other programs",
    )
    spacing_px: int = Field(4, ge=1, le=100, description="distance of the matched points")
    minimum_score: float = Field(
        0.8, gt=0.0, lt=1.0, description="least zero-normalised cross-correlation of a match"
    )
    maximum_sigma_px: float = Field(
        0.05, gt=0.0, description="largest standard deviation of a match, from noise and from its residual"
    )
    search_range_x_px: int = Field(
        40, ge=1, le=1000, description="largest displacement along the columns that seeds look for"
    )
    search_range_y_px: int = Field(
        40, ge=1, le=1000, description="largest displacement along the rows that seeds look for"
    )
    search_range_rotation_rad: float = Field(
        0.0,
        ge=0.0,
        le=3.1416,
        description="largest rotation in the image that seeds look for where no shift fits; 0.2 needs none",
    )

    @field_validator("region_of_interest", mode="before")
    @classmethod
    def _outlines_can_be_read(cls, given: object) -> object:
        """Join what commas have parted, and refuse what is no region."""
        text = " ".join(map(str, given)) if isinstance(given, list | tuple) else given
        if isinstance(text, str) and text:
            parse_outlines(text)
        return text

    texture: Literal["white", "fringe-average"] = Field(
        "fringe-average",
        description="image that is matched: the white frame, or the mean of all fringe frames, in which the "
        "fringes cancel and the camera's noise is lower by the square root of their number; a camera alone "
        "has but the white frame",
    )
    method: Method = Field(
        "gauss-newton",
        description="how a point is matched: by subsets that deform or, to compare with, by the peak of the "
        "thesis's cross-correlation (fourier-newton), a shift that is pulled towards whole pixels by up to a "
        "fifth of one and so asks for a maximum-sigma-px of about 0.3",
    )
    reference: Literal["first", "previous", "auto"] = Field(
        "first",
        description="what a state is matched with: the campaign's reference; the state before it, and "
        "displacements are added up; or, for large deformation, the reference wherever that can be done, "
        "from where the state before leads to, and elsewhere the state before",
    )
    following: Following = Field(
        "each-state",
        description="of views of several cameras without a projector: how the end of a displacement is found "
        "where the reference camera's match has ended. By the shape of each state, whose cameras are matched "
        "with each other; by each camera's texture from its own first image (own-reference), which leaves "
        "out of a displacement most of what the match between cameras is off by; or "
        "by matching the other cameras' images with the reference camera's first one (shared-reference)",
    )
    regions: Literal["measured", "none"] = Field(
        "measured",
        description="whether subsets end at the discontinuities of the measured shape, or, as in plain image "
        "correlation, know none: then they hold whatever is in their square; of a camera alone they end "
        "where its surface does",
    )
    discontinuity: EdgeTest = Field(
        "gap",
        description="what parts regions: a gap between neighbours that no crease explains, or a gradient "
        "steeper than maximum-slope-rad; that gradient alone (thesis Eq. 3.8, 3.9); or, to compare with, the "
        "distance of neighbours (thesis Eq. 3.5, 3.6)",
    )
    maximum_slope_rad: float = Field(
        _USUAL_EDGES.maximum_slope_rad,
        ge=0.1,
        le=1.55,
        description="steepest surface, from one that faces the camera, that is one region: a pixel covers "
        "its footprint over the cosine of this",
    )
    slope_half_width_px: int = Field(
        _USUAL_EDGES.half_width,
        ge=2,
        le=20,
        description="p of the thesis: a gradient is the slope of a line through the valid ones of 2 p + 1 px",
    )
    neighbour_distance_mm: float | None = Field(
        None,
        gt=0.0,
        description="for discontinuity = distance: neighbours this far apart in space are apart; what a "
        "pixel covers at maximum-slope-rad when not given",
    )
    edge_spacing_px: int | None = Field(
        None,
        ge=1,
        description="distance of the matched points within spacing-px of a region's edge; it must divide "
        "spacing-px and be at least a quarter of it; as elsewhere when not given",
    )
    minimum_subset_part: float = Field(
        0.2, gt=0.0, le=1.0, description="least part of a subset that lies on its point's region"
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

    @model_validator(mode="after")
    def _subsets_can_be_chosen(self) -> Self:
        if self.subsets == "adaptive" and (self.method != "gauss-newton" or self.reference != "first"):
            raise ValueError(
                "subsets = adaptive goes with method = gauss-newton and reference = first, not with "
                f"{self.method} and {self.reference}; leave out one or the other"
            )
        return self

    @model_validator(mode="after")
    def _partners_can_be_followed(self) -> Self:
        plain = self.method == "gauss-newton" and self.subsets == "fixed" and self.reference != "previous"
        if self.following != "each-state" and not plain:
            raise ValueError(
                f"following = {self.following} goes with method = gauss-newton, subsets = fixed and "
                f"reference = first or auto, not with {self.method}, {self.subsets} and {self.reference}; "
                "leave out one or the other"
            )
        return self

    @model_validator(mode="after")
    def _discontinuities_are_found_one_way(self) -> Self:
        chosen = edge_settings(self)
        if self.regions == "none" and chosen != _USUAL_EDGES:
            raise ValueError(
                "discontinuity, maximum_slope_rad, slope_half_width_px and neighbour_distance_mm are of "
                "regions = measured and mean nothing with regions = none; leave them out"
            )
        if chosen.distance is not None and chosen.test != "distance":
            raise ValueError(
                f"neighbour_distance_mm = {chosen.distance:g} means nothing with discontinuity = "
                f"{chosen.test}; leave it out or choose discontinuity = distance"
            )
        if chosen.test == "distance" and chosen.half_width != _USUAL_EDGES.half_width:
            raise ValueError(
                f"slope_half_width_px = {chosen.half_width} means nothing with discontinuity = distance, "
                "which fits no slope; leave it out or choose discontinuity = gradient"
            )
        if chosen.distance is not None and chosen.maximum_slope_rad != _USUAL_EDGES.maximum_slope_rad:
            raise ValueError(
                f"maximum_slope_rad = {chosen.maximum_slope_rad:g} means nothing beside "
                f"neighbour_distance_mm = {chosen.distance:g}; leave one of them out"
            )
        return self

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


def edge_settings(parameters: CorrelateParameters) -> EdgeSettings:
    """Return how discontinuities of the measured shape are found."""
    return EdgeSettings(
        parameters.discontinuity,
        parameters.slope_half_width_px,
        parameters.maximum_slope_rad,
        parameters.neighbour_distance_mm,
    )


def match_settings(parameters: CorrelateParameters, minimum_part: float = 0.2) -> MatchSettings:
    """Return how subsets are matched; `minimum_part` of one has to lie on its point's region."""
    return MatchSettings(
        parameters.subset_radius_px,
        minimum_part,
        tolerance=parameters.convergence_px,
        shape_order=cast(ShapeOrder, parameters.shape_order),
    )


def search_settings(parameters: CorrelateParameters) -> SearchSettings:
    """Return how far seeds look."""
    return SearchSettings(
        parameters.search_range_x_px,
        parameters.search_range_y_px,
        range_rotation=parameters.search_range_rotation_rad,
    )
