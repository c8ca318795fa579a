"""Gauges: what virtual strain gauges read on a tuple's stored displacement."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import gauge_from
from sms_jobs.kinds.kind import (
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
from sms_jobs.metrology.deformation.displacement import pixel_pitch
from sms_jobs.metrology.deformation.gauges import read_gauge
from sms_jobs.metrology.deformation.strain import independent_equivalent
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import turn_covariance
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import DisplacementField, PointCloud, Regions, StrainMeasure
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import AT_ORIGIN


class GaugesParameters(Parameters):
    """Where the gauges are, and which strain they read."""

    gauge: tuple[str, ...] = Field(
        min_length=1,
        description="gauges, each as 'NAME x=MM y=MM length=MM [width=MM] [angle=DEGREES]' in the specimen's "
        "frame, parted by semicolons; best declared once, under [processing.gauges] of the test plan",
    )
    measure: StrainMeasure = Field(
        "green-lagrange", description="Green-Lagrange strain, which no rotation changes, or small strain"
    )

    @field_validator("gauge", mode="before")
    @classmethod
    def _parted(cls, value: Any) -> Any:
        given = [value] if isinstance(value, str) else value
        if not isinstance(given, list | tuple):
            return value
        return tuple(part.strip() for text in given for part in str(text).split(";") if part.strip())

    @field_validator("gauge")
    @classmethod
    def _described(cls, gauges: tuple[str, ...]) -> tuple[str, ...]:
        try:
            names = [gauge_from(text)[0] for text in gauges]
        except InvalidInput as error:
            raise ValueError(str(error)) from error
        if len(set(names)) < len(names):
            raise ValueError("two gauges have one name")
        return gauges


def _needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    yield Need("displacement", "correlate", subject)
    yield Need("reference", "reconstruct", Subject(subject.campaign, campaign.reference.label, subject.pair))


def specimen_pose(campaign: Campaign, subject: Subject) -> Pose:
    """Return what brings the specimen's frame into the world; they are one where there is no scene."""
    return AT_ORIGIN if campaign.scene is None else campaign.scene.placement


def run(inputs: Inputs, parameters: GaugesParameters, progress: Progress) -> Iterator[Output]:
    """Fit the stored displacement under each gauge; nothing is correlated again."""
    moved = inputs.read("displacement", "displacement", DisplacementField)
    regions = inputs.read("displacement", "regions", Regions)
    cloud = inputs.read("reference", "cloud", PointCloud)
    labels = np.where(moved.reason == Reason.VALID, regions.labels, 0).astype(np.int32)
    pitch = pixel_pitch(cloud.xyz, labels, 0.5)
    placement: Pose = inputs.context
    turn = placement.matrix().T
    xyz = np.einsum("ij,jrc->irc", turn, cloud.xyz - np.array(placement.translation)[:, None, None])
    displacement = np.einsum("ij,jrc->irc", turn, moved.displacement)
    rows = []
    names = []
    for number, text in enumerate(parameters.gauge, start=1):
        name, place = gauge_from(text)
        covariance = independent_equivalent(
            moved.covariance,
            cloud.covariance,
            averaging_radius_px=moved.averaging_radius_px,
            subset_radius_px=moved.subset_radius_px,
            disc_radius_px=np.sqrt(place.length_mm * place.width_mm / np.pi) / pitch,
        )
        rows.append(
            read_gauge(
                place,
                xyz,
                displacement,
                turn_covariance(turn, covariance),
                labels,
                green_lagrange=parameters.measure == "green-lagrange",
            )
        )
        names.append(name)
        progress(number / len(parameters.gauge), f"read {name}")
    readings = GaugeReadings(
        parameters.measure,
        tuple(names),
        np.array([row.strain for row in rows]),
        np.array([row.sigma for row in rows], dtype=np.float32),
        np.stack([row.middle for row in rows]),
        np.array([row.pixels for row in rows], dtype=np.int32),
    )
    found = np.isfinite(readings.strain)
    statistics = {"gauges": float(len(names)), "gauges_read": float(found.sum())}
    if found.any():
        statistics["largest_gauge_strain"] = float(readings.strain[found].max())
    yield DatasetOutput(inputs.subject, {"gauges": readings}, statistics)


KIND = Kind(
    name="gauges",
    summary="strain that virtual gauges at given places read, from stored displacement",
    version=1,
    scope=Scope.TUPLE,
    parameters=GaugesParameters,
    needs=_needs,
    run=run,
    subjects=deformed_tuples,
    context=specimen_pose,
    in_pipeline=False,
)
