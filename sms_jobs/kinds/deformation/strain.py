"""Strain: from the displacement of a tuple to the strain in the surface's tangent plane."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.calibration_factors import states_of, strain_sigma
from sms_jobs.kinds.gauge_errors import errors_of_gauge
from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_tuples,
    deformed_views,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import AT_REST, MOVED
from sms_jobs.kinds.products import CALIBRATION_FACTOR, DISPLACEMENT, REGIONS, STRAIN, SURFACE
from sms_jobs.kinds.resolution import extent_of_pixels, resolution_statistics
from sms_jobs.kinds.surface_ports import surface_port
from sms_jobs.kinds.valid_parts import fractions
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch
from sms_jobs.metrology.deformation.fields.spatial_resolution import (
    left_by_gauge,
    left_by_square,
    strain_resolution,
)
from sms_jobs.metrology.deformation.strain.square import (
    radius_of_equal_spread,
    strain_over_squares,
)
from sms_jobs.metrology.deformation.strain.strain_errors import SharedErrors, Window
from sms_jobs.metrology.deformation.strain.tangent_plane import LEAST_PIXELS, SurfaceStrain, surface_strain
from sms_jobs.metrology.geometry.planes import in_space
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField, StrainField, StrainMeasure, Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Vector
from sms_jobs.records.statistic_names import MAXIMUM_PRINCIPAL_STRAIN
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

_USUAL_MM, _USUAL_PX, _USUAL_SQUARE_PX = 20.0, 60.0, 7
_LEAST_PX = 4.0
"""Shortest gauge: a disc about a pixel that reaches its second neighbours."""
_MOST_DIAGONALS = 2.0
"""Longest gauge, in diagonals of the image: a disc about any pixel then covers all of it."""


class StrainParameters(Parameters):
    """Over what length strain is taken, and which strain."""

    gauge_length_mm: float | None = Field(
        None,
        gt=0.0,
        description=f"diameter of the disc of surface over which displacement is fitted; {_USUAL_MM:g} mm "
        "if not given",
    )
    gauge_length_px: float | None = Field(
        None,
        gt=2.0,
        description="the same in the image of a camera alone, where its length in mm is not given; "
        f"{_USUAL_PX:g} px if neither is; refused where all views measure surfaces",
    )
    method: Literal["disc", "square"] = Field(
        "disc",
        description="disc: a plane fitted to displacement over a disc of surface; square, the thesis's "
        "(section 6.2.5): lines fitted along rows and columns of a square of pixels, their slopes averaged",
    )
    square_px: int = Field(
        _USUAL_SQUARE_PX,
        ge=3,
        le=101,
        description="side N_s of the square, an odd number of pixels, for method = square",
    )
    measure: StrainMeasure = Field(
        "green-lagrange", description="Green-Lagrange strain, which no rotation changes, or small strain"
    )
    fold_angle_deg: float = Field(
        20.0,
        gt=0.0,
        le=180.0,
        description="a gauge disc, or a square, ends where the surface has turned by more than this from its "
        "centre; 180 for no such limit",
    )

    @model_validator(mode="after")
    def _one_gauge_is_given(self) -> Self:
        if self.method == "disc" and self.square_px != _USUAL_SQUARE_PX:
            raise ValueError(
                f"square_px = {self.square_px} means nothing with method = disc; leave it out or choose "
                "method = square"
            )
        for name, length in (("mm", self.gauge_length_mm), ("px", self.gauge_length_px)):
            if self.method == "square" and length is not None:
                raise ValueError(
                    f"gauge_length_{name} = {length:g} is of discs and means nothing with method = square; "
                    "leave it out and give square_px"
                )
        if self.square_px % 2 == 0:
            raise ValueError(
                f"square_px = {self.square_px} has no pixel in the middle; choose {self.square_px + 1}"
            )
        return self


_MOVED = Port(MOVED, "correlate", (DISPLACEMENT, REGIONS, CALIBRATION_FACTOR))
_REFERENCE = surface_port(AT_REST)


def _needs(campaign: Campaign, subject: Subject, parameters: StrainParameters) -> Iterable[Need]:
    yield _MOVED.of(subject)
    yield _REFERENCE.of(campaign, replace(subject, state=campaign.reference.label))


def x_axis_of(campaign: Campaign, subject: Subject) -> Vector:
    """Return the x axis of strain: the specimen's, in an image that along its rows."""
    if not view_of(subject.view).measures_shape:
        return (1.0, 0.0, 0.0)
    x, y, z = campaign.placement.matrix()[:, 0]
    return (float(x), float(y), float(z))


def gauge_length_of(surface: Surface, parameters: StrainParameters) -> float:
    """Return the gauge length in the unit of a surface; `InvalidInput` for mm where no scale is known."""
    in_mm, in_px = parameters.gauge_length_mm, parameters.gauge_length_px
    if surface.has_depth:
        return _USUAL_MM if in_mm is None else in_mm
    size = 1.0 if surface.mm_per_px is None else surface.mm_per_px
    if in_mm is None:
        return size * (_USUAL_PX if in_px is None else in_px)
    if surface.unit == "mm":
        return in_mm
    if in_px is None:
        raise InvalidInput(
            f"the image of {surface.view} has no scale, so a gauge length of {in_mm:g} mm means nothing "
            "there; give gauge-length-px, or the size of a pixel as plane.mm_per_px"
        )
    return in_px


@dataclass(frozen=True)
class _Gauge:
    """Over what strain is taken: its length, in the surface's unit, and the radius of a disc like it, in px.

    A disc like a square is that in which points scatter as much; `square_px` is None for a disc.
    """

    length: float
    disc_radius_px: float
    square_px: int | None = None


def _gauge_of(surface: Surface, pitch: float, parameters: StrainParameters) -> _Gauge:
    """Return the gauge on a surface of which a pixel sees `pitch`."""
    if parameters.method == "square":
        side = parameters.square_px
        return _Gauge(side * pitch, radius_of_equal_spread(side), side)
    length = gauge_length_of(surface, parameters)
    rows, columns = surface.reason.shape
    longest = _MOST_DIAGONALS * math.hypot(rows, columns)
    if length > longest * pitch:
        raise InvalidInput(
            f"a gauge length of {length:g} {surface.unit} is {length / pitch:.4g} px in the image of "
            f"{surface.view}, which has {columns} x {rows} px: at most {longest:.4g} px, "
            f"{longest * pitch:.4g} {surface.unit}, can be fitted; give a shorter one"
        )
    return _Gauge(length, 0.5 * length / pitch)


def _refuse_too_short(surface: Surface, gauge: _Gauge) -> None:
    """Raise `InvalidInput` where a disc is so small that no pixel has enough others about it."""
    length_px = 2.0 * gauge.disc_radius_px
    if gauge.square_px is None and length_px < _LEAST_PX:
        raise InvalidInput(
            f"a gauge length of {gauge.length:g} {surface.unit} is {length_px:.3g} px in the image of "
            f"{surface.view}, and strain is fitted to at least {LEAST_PIXELS} pixels, which a disc of "
            f"{_LEAST_PX:g} px, {_LEAST_PX * gauge.length / length_px:.3g} {surface.unit}, holds: give a "
            "longer one"
        )


def _strained(
    inputs: Inputs,
    surface: Surface,
    moved: DisplacementField,
    labels: NDArray[np.int32],
    gauge: _Gauge,
    parameters: StrainParameters,
) -> SurfaceStrain:
    """Return the strain over a gauge."""
    position, displacement = in_space(surface.position), in_space(moved.displacement)

    def errors_of(side: int) -> SharedErrors:
        return errors_of_gauge(moved, surface, radius_of_equal_spread(side), Window(side, side))

    green = parameters.measure == "green-lagrange"
    fold = float(np.radians(parameters.fold_angle_deg))
    if gauge.square_px is not None:
        return strain_over_squares(
            position,
            displacement,
            errors_of,
            labels,
            side=gauge.square_px,
            x_axis=inputs.context,
            green_lagrange=green,
            fold_angle_rad=fold,
            threads=inputs.threads,
        )
    return surface_strain(
        position,
        displacement,
        errors_of_gauge(moved, surface, gauge.disc_radius_px),
        labels,
        gauge_length=gauge.length,
        x_axis=inputs.context,
        green_lagrange=green,
        fold_angle_rad=fold,
        threads=inputs.threads,
    )


def run(inputs: Inputs, parameters: StrainParameters, progress: Progress) -> Iterator[Output]:
    """Differentiate the stored displacement over the stored surface; nothing is correlated again."""
    surface = inputs.read(_REFERENCE.port, SURFACE)
    moved = inputs.read(_MOVED, DISPLACEMENT)
    regions = inputs.read(_MOVED, REGIONS)
    known = np.where(moved.reason == Reason.VALID, regions.labels, 0)
    gauge = _gauge_of(surface, pixel_pitch(in_space(surface.position), known, 0.5), parameters)
    found = _strained(inputs, surface, moved, regions.labels, gauge, parameters)
    reason = moved.reason.copy()
    reason[(reason == Reason.VALID) & np.isnan(found.strain[0])] = Reason.TOO_FEW_NEIGHBOURS
    if (moved.reason == Reason.VALID).any() and not (reason == Reason.VALID).any():
        _refuse_too_short(surface, gauge)
    field = StrainField(
        parameters.measure,
        moved.unit,
        gauge.length,
        found.strain,
        found.sigma.astype(np.float32),
        found.principal,
        found.von_mises,
        reason,
        x_axis=inputs.context,
        bias=found.bias.astype(np.float32),
        square_px=gauge.square_px,
    )
    if moved.resolution is not None:
        field = _with_resolution(field, moved.resolution, surface, regions.labels, moved.subset_radius_px)
    states = states_of(inputs, _MOVED)
    if states is not None:
        like_it = gauge.length
        if gauge.square_px is not None:
            like_it *= 2.0 * gauge.disc_radius_px / gauge.square_px
        sigma = strain_sigma(
            states,
            surface,
            moved,
            regions.labels,
            like_it,
            gauge.disc_radius_px,
            inputs.context,
            green_lagrange=parameters.measure == "green-lagrange",
        )
        sigma[:, reason != Reason.VALID] = np.nan
        field = replace(field, sigma_calibration=sigma)
    progress(1.0, "fitted the strain")
    yield DatasetOutput(inputs.subject, {STRAIN: field}, _statistics(field, surface))


def _with_resolution(
    field: StrainField,
    of_displacement: NDArray[np.float32],
    surface: Surface,
    labels: NDArray[np.int32],
    radius_px: int,
) -> StrainField:
    """Return strain with the spatial resolution that displacement and gauge leave it."""
    left = left_by_gauge if field.square_px is None else left_by_square
    found = strain_resolution(of_displacement, field.gauge_length, left).astype(np.float32)
    found[field.reason != Reason.VALID] = np.nan
    in_px = found / extent_of_pixels(surface, labels, radius_px)
    median = float(np.nanmedian(in_px)) if np.isfinite(in_px).any() else None
    return replace(field, resolution_px=median, resolution=found)


def _statistics(field: StrainField, surface: Surface) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = field.reason == Reason.VALID
    statistics = fractions(valid, surface.reason == Reason.VALID)
    if valid.any():
        statistics |= {
            MAXIMUM_PRINCIPAL_STRAIN: float(field.principal[0][valid].max()),
            "minimum_principal_strain": float(field.principal[1][valid].min()),
            "median_von_mises_strain": float(np.median(field.von_mises[valid])),
            "median_sigma_strain": float(np.median(field.sigma[:, valid])),
            **resolution_statistics(field),
        }
        if field.sigma_calibration is not None:
            part = field.sigma_calibration[:, valid]
            statistics["median_sigma_calibration_strain"] = float(np.nanmedian(part))
    return statistics


KIND = Kind(
    name="strain",
    summary="strain in the tangent plane, with principal and equivalent strain, over a stated gauge length",
    version=18,
    scope=Scope.TUPLE,
    parameters=StrainParameters,
    inputs=(_MOVED, *_REFERENCE.all),
    outputs=(STRAIN,),
    needs=_needs,
    run=run,
    subjects=deformed_views,
    pipeline_subjects=deformed_tuples,
    context=x_axis_of,
    along_frame=True,
)
