"""Strain: from the displacement of a tuple to the strain in the surface's tangent plane."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from pydantic import Field

from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Port,
    Progress,
    Scope,
    deformed_tuples,
)
from sms_jobs.kinds.products import CLOUD, DISPLACEMENT, REGIONS, STRAIN
from sms_jobs.kinds.valid_parts import fractions
from sms_jobs.metrology.deformation.displacement import pixel_pitch
from sms_jobs.metrology.deformation.strain import independent_equivalent, surface_strain
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import PointCloud, StrainField, StrainMeasure
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Vector


class StrainParameters(Parameters):
    """Over what length strain is taken, and which strain."""

    gauge_length_mm: float = Field(
        20.0, gt=0.0, description="diameter of the disc of surface over which displacement is fitted"
    )
    measure: StrainMeasure = Field(
        "green-lagrange", description="Green-Lagrange strain, which no rotation changes, or small strain"
    )
    fold_angle_deg: float = Field(
        20.0,
        gt=0.0,
        le=180.0,
        description="a gauge disc ends where the surface has turned by more than this from its centre; 180 "
        "for no such limit",
    )


_MOVED = Port("displacement", "correlate", (DISPLACEMENT, REGIONS))
_REFERENCE = Port("reference", "reconstruct", (CLOUD,))


def _needs(campaign: Campaign, subject: Subject, parameters: StrainParameters) -> Iterable[Need]:
    yield _MOVED.of(subject)
    yield _REFERENCE.of(replace(subject, state=campaign.reference.label))


def specimen_axis(campaign: Campaign, subject: Subject) -> Vector:
    """Return the specimen's x axis in the world: from the scene, or the world's X where there is none."""
    if campaign.scene is None:
        return (1.0, 0.0, 0.0)
    x, y, z = campaign.scene.placement.matrix()[:, 0]
    return (float(x), float(y), float(z))


def run(inputs: Inputs, parameters: StrainParameters, progress: Progress) -> Iterator[Output]:
    """Differentiate the stored displacement over the stored shape; nothing is correlated again."""
    moved = inputs.read(_MOVED, DISPLACEMENT)
    regions = inputs.read(_MOVED, REGIONS)
    cloud = inputs.read(_REFERENCE, CLOUD)
    pitch = pixel_pitch(cloud.xyz, np.where(moved.reason == Reason.VALID, regions.labels, 0), 0.5)
    found = surface_strain(
        cloud.xyz,
        moved.displacement,
        independent_equivalent(
            moved.covariance,
            cloud.covariance,
            averaging_radius_px=moved.averaging_radius_px,
            subset_radius_px=moved.subset_radius_px,
            disc_radius_px=0.5 * parameters.gauge_length_mm / pitch,
        ),
        regions.labels,
        gauge_length_mm=parameters.gauge_length_mm,
        x_axis=inputs.context,
        green_lagrange=parameters.measure == "green-lagrange",
        fold_angle_rad=float(np.radians(parameters.fold_angle_deg)),
        threads=inputs.threads,
    )
    reason = moved.reason.copy()
    reason[(reason == Reason.VALID) & np.isnan(found.strain[0])] = Reason.TOO_FEW_NEIGHBOURS
    field = StrainField(
        parameters.measure,
        parameters.gauge_length_mm,
        found.strain,
        found.sigma.astype(np.float32),
        found.principal,
        found.von_mises,
        reason,
    )
    progress(1.0, "fitted the strain")
    yield DatasetOutput(inputs.subject, {STRAIN: field}, _statistics(field, cloud))


def _statistics(field: StrainField, cloud: PointCloud) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = field.reason == Reason.VALID
    statistics = fractions(valid, cloud.reason == Reason.VALID)
    if valid.any():
        statistics |= {
            "maximum_principal_strain": float(field.principal[0][valid].max()),
            "minimum_principal_strain": float(field.principal[1][valid].min()),
            "median_von_mises_strain": float(np.median(field.von_mises[valid])),
            "median_sigma_strain": float(np.median(field.sigma[:, valid])),
        }
    return statistics


KIND = Kind(
    name="strain",
    summary="strain in the tangent plane, with principal and equivalent strain, over a stated gauge length",
    version=3,
    scope=Scope.TUPLE,
    parameters=StrainParameters,
    inputs=(_MOVED, _REFERENCE),
    outputs=(STRAIN,),
    needs=_needs,
    run=run,
    subjects=deformed_tuples,
    context=specimen_axis,
)
