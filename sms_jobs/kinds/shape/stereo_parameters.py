"""What can be chosen about matching textures between cameras."""

from __future__ import annotations

from pydantic import Field

from sms_jobs.kinds.parameters import Parameters
from sms_jobs.metrology.images.smoothing import LARGEST_SMOOTHING_PX


class StereoParameters(Parameters):
    """How textures are matched between cameras, and which points are trusted."""

    smoothing_px: float = Field(
        0.6,
        ge=0.0,
        le=LARGEST_SMOOTHING_PX,
        description="standard deviation of the filter that all textures pass before they are matched; 0 for "
        "none",
    )
    subset_radius_px: int = Field(
        12, ge=3, le=100, description="a subset has (2 radius + 1)^2 pixels, less those beside the specimen"
    )
    shape_order: int = Field(
        2, ge=0, le=2, description="how a subset may deform between cameras: 0 shift, 1 affine, 2 quadratic"
    )
    spacing_px: int = Field(5, ge=1, le=100, description="distance of the matched points")
    convergence_px: float = Field(
        5e-4, gt=0.0, le=0.1, description="rms movement of a subset's pixels at which its iteration ends"
    )
    minimum_score: float = Field(
        0.8, gt=0.0, lt=1.0, description="least zero-normalised cross-correlation of a match"
    )
    maximum_sigma_px: float = Field(
        0.1, gt=0.0, description="largest standard deviation of a match, from noise and from its residual"
    )
    minimum_subset_part: float = Field(
        0.3, gt=0.0, le=1.0, description="least part of a subset that shows the specimen"
    )
    epipolar_width_px: float | None = Field(
        None,
        gt=0.0,
        le=100.0,
        description="how far off the image of a pixel's ray its counterpart is looked for at first; six "
        "standard deviations of what the calibration says of itself if not given, 3 where it says nothing",
    )
    maximum_epipolar_px: float = Field(
        1.0,
        gt=0.0,
        description="largest median distance of the matches from the images of their rays; beyond, the "
        "calibration is not that of these images",
    )
    edge_margin_px: int = Field(
        3,
        ge=1,
        le=50,
        description="rim of the specimen that no subset looks at: it mixes with what lies behind, which "
        "moves otherwise from camera to camera",
    )
    outline: bool = Field(
        True,
        description="whether the specimen ends where its texture ends: no subset then looks behind it",
    )
