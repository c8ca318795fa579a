"""Align: the views of other campaigns laid on those of this one by the texture that both saw at rest.

Thesis section 6.2.3: a specimen larger than the measured volume is tested with the rig in one position after
the other. Each position is a campaign with states and views of the same names; the rig's frame moves with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.deformation.textured_state import read_texture
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Kind, Need, Output, Progress, Scope
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import SHAPE
from sms_jobs.kinds.products import ALIGNMENT, SURFACE, Product
from sms_jobs.kinds.shape.camera_views import cameras
from sms_jobs.kinds.surface_ports import independent_covariance, position_covariance, state_ports
from sms_jobs.metrology.deformation.joining.alignment import (
    Alignment,
    CommonPoints,
    View,
    align_views,
    common_points,
)
from sms_jobs.metrology.deformation.joining.alignment_start import overlapping
from sms_jobs.metrology.deformation.matching.correlation import MatchSettings
from sms_jobs.metrology.deformation.matching.grid import GridSettings
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.surfaces.continuity import continuous_labels
from sms_jobs.records.alignment import ViewAlignment
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.reasons import Reason
from sms_jobs.records.remarks import remarked
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject, checked_name

_FAR_OFF = 6.0
"""How far points may miss each other, in deviations that are stated, without a remark."""

_ROUNDS = 2  # the second starts from what the first found, and so finds points at the rim of the overlap


class ViewsParameters(Parameters):
    """Which campaigns are taken together."""

    views: tuple[str, ...] = Field(
        min_length=1,
        description="names of the campaigns in which the rig stood elsewhere, parted by commas or spaces; "
        "their states and views have the names that they have here",
    )

    @field_validator("views", mode="before")
    @classmethod
    def _parted(cls, value: Any) -> Any:
        given = [value] if isinstance(value, str) else value
        if not isinstance(given, list | tuple):
            return value
        return tuple(name for text in given for name in str(text).replace(",", " ").split())

    @field_validator("views")
    @classmethod
    def _named(cls, views: tuple[str, ...]) -> tuple[str, ...]:
        try:
            names = [checked_name(view, "campaign") for view in views]
        except InvalidInput as error:
            raise ValueError(str(error)) from error
        if len(set(names)) < len(names):
            raise ValueError("a campaign is named twice")
        return views


class AlignParameters(ViewsParameters):
    """How the views are matched."""

    subset_radius_px: int = Field(
        16, ge=3, le=100, description="of the subsets by which points are found, a subset apart"
    )
    smoothing_px: float = Field(
        0.6, ge=0.0, le=3.0, description="of the filter that both textures pass before they are matched"
    )
    averaging_radius_px: float = Field(
        4.0, ge=1.5, le=50.0, description="radius within which positions are averaged"
    )
    search_range_rotation_rad: float = Field(
        0.4,
        ge=0.0,
        le=3.1416,
        description="largest rotation in the image that is looked for where no shift fits",
    )
    minimum_score: float = Field(
        0.8, gt=0.0, lt=1.0, description="least zero-normalised cross-correlation of a match"
    )
    maximum_sigma_px: float = Field(0.1, gt=0.0, description="largest standard deviation of a match")


_AT_REST = state_ports(SHAPE, "texture", several=True)


def _needs(campaign: Campaign, subject: Subject, parameters: AlignParameters) -> Iterable[Need]:
    """Yield texture and shape at rest of one view of each camera, here and at the other positions."""
    for name in (subject.campaign, *parameters.views):
        for own in _at_rest(campaign, subject):
            yield from _AT_REST.of(campaign, replace(own, campaign=name))


def _at_rest(campaign: Campaign, subject: Subject) -> tuple[Subject, ...]:
    """Return one tuple of each camera at the reference state."""
    label = campaign.reference.label
    return tuple(Subject(campaign.name, label, views[0]) for views in cameras(campaign, subject).values())


def run(inputs: Inputs, parameters: AlignParameters, progress: Progress) -> Iterator[Output]:
    """Find how each of the other views lies to this one."""
    seen: tuple[Subject, ...] = inputs.context
    own = inputs.subject.campaign
    if own in parameters.views:
        raise InvalidInput(
            f"campaign {own} cannot be aligned with itself; name the other positions of the rig"
        )
    here = [_view(inputs, each, parameters) for each in seen]
    records: dict[Product[Any], ViewAlignment] = {}
    statistics: dict[str, float] = {}
    misfits: list[str] = []
    for number, name in enumerate(parameters.views, start=1):
        there = [_view(inputs, replace(each, campaign=name), parameters) for each in seen]
        points, found = _aligned(here, there, parameters, inputs.threads)
        records[ALIGNMENT.of(str(number))] = _record(name, points, found)
        statistics |= {
            f"alignment_rms_mm_{number}": found.rms_mm,
            f"alignment_scale_{number}": found.scale,
            f"points_{number}": float(len(points.here)),
        }
        misfits.append(_misfit(name, points, found))
        done = f"aligned {name} by {number_of(len(points.here), 'point')}"
        progress(number / len(parameters.views), remarked(*misfits, beside=done))
    yield DatasetOutput(inputs.subject, records, statistics)


def _view(inputs: Inputs, about: Subject, parameters: AlignParameters) -> View:
    surface = inputs.read(_AT_REST.surface.port, SURFACE, about)
    valid = surface.reason == Reason.VALID
    smoothed = CorrelateParameters(smoothing_px=parameters.smoothing_px)
    texture, noise = read_texture(inputs, _AT_REST, smoothed, valid, valid, about)
    covariance = position_covariance(surface).astype(np.float64)
    independent = None if surface.subset_radius_px else independent_covariance(surface).astype(np.float64)
    sigma = np.sqrt(trace(covariance))
    xyz = np.where(valid, surface.position, np.nan)
    labels = continuous_labels(xyz, sigma, threads=inputs.threads)
    view = View(texture, noise, xyz, covariance, labels, independent)
    return view.averaged(parameters.averaging_radius_px, inputs.threads)


def _aligned(
    here: list[View], there: list[View], parameters: AlignParameters, threads: int
) -> tuple[CommonPoints, Alignment]:
    """Return the points that the cameras see from both positions, and the motion between these."""
    # A view from elsewhere bends straight lines of pixels, which a subset of first order would be biased by.
    settings = MatchSettings(parameters.subset_radius_px, shape_order=2)
    grid = GridSettings(minimum_score=parameters.minimum_score, maximum_sigma=parameters.maximum_sigma_px)
    pose = _start(here, there, parameters.search_range_rotation_rad, threads)
    for _ in range(_ROUNDS):
        each = [common_points(a, b, pose, settings, grid, threads) for a, b in zip(here, there, strict=True)]
        points = each[0]
        for more in each[1:]:
            points = points.and_those(more)
        found = align_views(points, pose)
        pose = found.pose
    return points, found


def _start(here: list[View], there: list[View], range_rotation: float, threads: int) -> Pose:
    """Return where the first camera that sees some of the overlap finds it."""
    for a, b in zip(here[:-1], there[:-1], strict=True):
        with suppress(MeasurementFailed):
            return overlapping(a, b, range_rotation, threads)
    return overlapping(here[-1], there[-1], range_rotation, threads)


def _misfit(name: str, points: CommonPoints, found: Alignment) -> str:
    """Return how far the points miss each other, and how that may be, where it is far more than is stated."""
    if found.scale <= _FAR_OFF:
        return ""
    here, there = (np.var(p[found.used], axis=0).sum() for p in (points.here, points.there))
    return (
        f"the points of {name} miss those here by {found.rms_mm:.2g} mm, {found.scale:.0f} times what is "
        f"stated: lengths there are {np.sqrt(there / here):.4f} of those here; see whether both calibrations "
        "have one scale, and whether the specimen had one shape"
    )


def _record(name: str, points: CommonPoints, found: Alignment) -> ViewAlignment:
    pose: Pose = found.pose
    used: NDArray[np.bool_] = found.used
    return ViewAlignment(
        name,
        pose.rotation,
        pose.translation,
        found.scale,
        found.rms_mm,
        len(used),
        float(used.mean()),
        found.covariance,
        points.here,
        found.residual,
    )


KIND = Kind(
    name="align",
    summary="how other campaigns' views lie to this one's, by the texture of the specimen, and the residual",
    version=6,
    scope=Scope.CAMPAIGN,
    parameters=AlignParameters,
    inputs=_AT_REST.all,
    outputs=(ALIGNMENT.by("number"),),
    needs=_needs,
    run=run,
    context=_at_rest,
    in_pipeline=False,
)
