"""Strain images: strain in the plane of the image, from stored displacement in the image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from pydantic import Field

from sms_jobs.errors import InvalidInput
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
    deformed_images,
    deformed_images_alone,
)
from sms_jobs.kinds.planes import as_surface
from sms_jobs.kinds.products import PLANAR_DISPLACEMENT, PLANAR_STRAIN
from sms_jobs.kinds.valid_parts import fractions, textured
from sms_jobs.metrology.deformation.strain import independent_equivalent, surface_strain
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import StrainMeasure
from sms_jobs.records.planar import PlanarStrain
from sms_jobs.records.reasons import Reason


class StrainImagesParameters(Parameters):
    """Over what length strain is taken, and which strain."""

    gauge_length_px: float = Field(
        60.0, gt=2.0, description="diameter of the disc over which displacement is fitted"
    )
    gauge_length_mm: float | None = Field(
        None, gt=0.0, description="the same in mm, where the displacement has a scale"
    )
    measure: StrainMeasure = Field(
        "green-lagrange", description="Green-Lagrange strain, which no rotation changes, or small strain"
    )


_MOVED = Port("displacement", "correlate-images", (PLANAR_DISPLACEMENT,))


def _needs(campaign: Campaign, subject: Subject, parameters: StrainImagesParameters) -> Iterable[Need]:
    yield _MOVED.of(subject)


def run(inputs: Inputs, parameters: StrainImagesParameters, progress: Progress) -> Iterator[Output]:
    """Differentiate the stored displacement; nothing is correlated again."""
    moved = inputs.read(_MOVED, PLANAR_DISPLACEMENT)
    gauge = parameters.gauge_length_px
    if parameters.gauge_length_mm is not None:
        if moved.mm_per_px is None:
            raise InvalidInput(
                f"the displacement of {inputs.subject} has no scale, so a gauge length of "
                f"{parameters.gauge_length_mm:g} mm means nothing; give gauge-length-px, or correlate again "
                "with mm-per-px"
            )
        gauge = parameters.gauge_length_mm / moved.mm_per_px
    plane = as_surface(moved)
    found = surface_strain(
        plane.xyz,
        plane.displacement,
        independent_equivalent(
            plane.covariance,
            np.zeros_like(plane.covariance),
            averaging_radius_px=0.0,
            subset_radius_px=moved.subset_radius_px,
            disc_radius_px=0.5 * gauge,
        ),
        plane.labels,
        gauge_length_mm=gauge,
        green_lagrange=parameters.measure == "green-lagrange",
        threads=inputs.threads,
    )
    reason = moved.reason.copy()
    reason[(reason == Reason.VALID) & np.isnan(found.strain[0])] = Reason.TOO_FEW_NEIGHBOURS
    field = PlanarStrain(
        parameters.measure,
        gauge,
        moved.mm_per_px,
        found.strain,
        found.sigma.astype(np.float32),
        found.principal,
        found.von_mises,
        reason,
    )
    valid = reason == Reason.VALID
    statistics = fractions(valid, textured(reason))
    if valid.any():
        statistics |= {
            "maximum_principal_strain": float(field.principal[0][valid].max()),
            "minimum_principal_strain": float(field.principal[1][valid].min()),
            "median_sigma_strain": float(np.median(field.sigma[:, valid])),
        }
    progress(1.0, "fitted the strain")
    yield DatasetOutput(inputs.subject, {PLANAR_STRAIN: field}, statistics)


KIND = Kind(
    name="strain-images",
    summary="strain in the plane of the image, from displacement that correlate-images stored",
    version=2,
    scope=Scope.TUPLE,
    parameters=StrainImagesParameters,
    inputs=(_MOVED,),
    outputs=(PLANAR_STRAIN,),
    needs=_needs,
    run=run,
    subjects=deformed_images,
    pipeline_subjects=deformed_images_alone,
)
