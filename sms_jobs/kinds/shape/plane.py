"""Plane: the image of a camera alone as a surface, of which the specimen is what has texture."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np
from pydantic import Field

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
    planes,
    planes_alone,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import MEASURED, SURFACE
from sms_jobs.kinds.shape.textures import white_texture
from sms_jobs.kinds.valid_parts import fractions
from sms_jobs.metrology.geometry.planes import pixels_as_plane
from sms_jobs.metrology.images.smoothing import LARGEST_SMOOTHING_PX
from sms_jobs.metrology.images.texture_extent import textured_pixels
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject


class PlaneParameters(Parameters):
    """How large a pixel is, and where the specimen ends."""

    mm_per_px: float | None = Field(
        None,
        ge=1e-9,
        le=1e6,
        description="size of a pixel on the specimen; without it results are in pixels",
    )
    outline: Literal["texture", "none"] = Field(
        "texture",
        description="whether the specimen ends where its texture ends, so that no subset looks at the "
        "background or into a hole; none takes the whole image",
    )
    smoothing_px: float = Field(
        0.6,
        ge=0.0,
        le=LARGEST_SMOOTHING_PX,
        description="standard deviation of the filter that the texture passes before its extent is found",
    )
    coarsest_px: int = Field(
        10,
        ge=1,
        le=100,
        description="plain places narrower than twice this belong to the specimen: its speckle may be as "
        "coarse",
    )


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,))


def _needs(campaign: Campaign, subject: Subject, parameters: PlaneParameters) -> Iterable[Need]:
    yield _FRAMES.of(subject)


def run(inputs: Inputs, parameters: PlaneParameters, progress: Progress) -> Iterator[Output]:
    """Say of every pixel of the reference image where it lies, and whether it shows the specimen."""
    surface = plane_of(inputs.read(_FRAMES, MEASURED), str(inputs.view), parameters)
    valid = surface.reason == Reason.VALID
    progress(1.0, f"{np.count_nonzero(valid)} of {valid.size} pixels show the specimen")
    yield DatasetOutput(inputs.subject, {SURFACE: surface}, fractions(valid, np.ones_like(valid)))


def plane_of(measurement: Measurement, view: str, parameters: PlaneParameters) -> Surface:
    """Return the image of a camera alone as a surface, in mm if the size of a pixel is known."""
    shape = measurement.texture.shape
    reason = np.zeros(shape, dtype=np.uint32)
    if parameters.outline == "texture":
        level, noise = white_texture(measurement, parameters.smoothing_px, np.ones(shape, dtype=bool))
        seen = textured_pixels(level, noise.floor + noise.slope * level, parameters.coarsest_px)
        reason[~seen] = Reason.NO_TEXTURE
    scale = parameters.mm_per_px
    position = pixels_as_plane(shape, 1.0 if scale is None else scale)
    position[:, reason != 0] = np.nan
    return Surface(view, "px" if scale is None else "mm", position, reason, mm_per_px=scale)


KIND = Kind(
    name="plane",
    summary="the image of a camera alone as a surface: where the specimen is, and how large a pixel",
    version=3,
    scope=Scope.TUPLE,
    parameters=PlaneParameters,
    inputs=(_FRAMES,),
    outputs=(SURFACE,),
    needs=_needs,
    run=run,
    subjects=planes,
    pipeline_subjects=planes_alone,
)
