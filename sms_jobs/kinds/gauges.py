"""Gauges: what virtual strain gauges read on a tuple's stored displacement."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import DescribedGauge, described_gauge, gauge_from
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
)
from sms_jobs.kinds.planes import as_surface
from sms_jobs.kinds.products import CLOUD, DISPLACEMENT, GAUGES, PLANAR_DISPLACEMENT, REGIONS
from sms_jobs.metrology.deformation.displacement import pixel_pitch
from sms_jobs.metrology.deformation.gauges import GaugePlace, GaugeValue, read_gauge
from sms_jobs.metrology.deformation.strain import independent_equivalent
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import turn_covariance
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import StrainMeasure
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.planar import PlanarDisplacement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import AT_ORIGIN
from sms_jobs.records.views import view_of


class GaugesParameters(Parameters):
    """Where the gauges are, and which strain they read."""

    gauge: tuple[str, ...] = Field(
        min_length=1,
        description="gauges, each as 'NAME x=MM y=MM length=MM [width=MM] [angle=DEGREES]' in the "
        "specimen's frame, parted by semicolons; of a camera alone in its reference image, x rightwards and "
        "y down from its first pixel, also in pixels, as in x=450px; best declared once, under "
        "[processing.gauges] of the test plan",
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
            names = [described_gauge(text).name for text in gauges]
        except InvalidInput as error:
            raise ValueError(str(error)) from error
        if len(set(names)) < len(names):
            raise ValueError("two gauges have one name")
        return gauges


_MOVED = Port("displacement", "correlate", (DISPLACEMENT, REGIONS))
_MOVED_IN_IMAGE = Port("displacement", "correlate-images", (PLANAR_DISPLACEMENT,))
_REFERENCE = Port("reference", "reconstruct", (CLOUD,))


def _needs(campaign: Campaign, subject: Subject, parameters: GaugesParameters) -> Iterable[Need]:
    if not view_of(subject.view).measures_shape:
        yield _MOVED_IN_IMAGE.of(subject)
        return
    yield _MOVED.of(subject)
    yield _REFERENCE.of(replace(subject, state=campaign.reference.label))


def specimen_pose(campaign: Campaign, subject: Subject) -> Pose:
    """Return what brings the specimen's frame into the world; they are one where there is no scene."""
    return AT_ORIGIN if campaign.scene is None else campaign.scene.placement


def run(inputs: Inputs, parameters: GaugesParameters, progress: Progress) -> Iterator[Output]:
    """Fit the stored displacement under each gauge; nothing is correlated again."""
    on_surface = inputs.view.measures_shape
    found = (_on_surface if on_surface else _in_image)(inputs, parameters, progress)
    names = tuple(described_gauge(text).name for text in parameters.gauge)
    readings = GaugeReadings(
        parameters.measure,
        names,
        np.array([value.strain for value in found.values]),
        np.array([value.sigma for value in found.values], dtype=np.float32),
        found.place_mm,
        np.array([value.pixels for value in found.values], dtype=np.int32),
        found.place_px,
    )
    known = np.isfinite(readings.strain)
    statistics = {"gauges": float(len(names)), "gauges_read": float(known.sum())}
    if known.any():
        statistics["largest_gauge_strain"] = float(readings.strain[known].max())
    yield DatasetOutput(inputs.subject, {GAUGES: readings}, statistics)


@dataclass(frozen=True)
class _Found:
    """What the gauges read, and where their middles are: (gauges, 3) in mm, (gauges, 2) in px."""

    values: list[GaugeValue]
    place_mm: NDArray[np.float64]
    place_px: NDArray[np.float64] | None = None


def _on_surface(inputs: Inputs, parameters: GaugesParameters, progress: Progress) -> _Found:
    """Read gauges on a surface that fringes have measured, in the specimen's frame."""
    moved = inputs.read(_MOVED, DISPLACEMENT)
    regions = inputs.read(_MOVED, REGIONS)
    cloud = inputs.read(_REFERENCE, CLOUD)
    labels = np.where(moved.reason == Reason.VALID, regions.labels, 0).astype(np.int32)
    pitch = pixel_pitch(cloud.xyz, labels, 0.5)
    placement: Pose = inputs.context
    turn = placement.matrix().T
    xyz = np.einsum("ij,jrc->irc", turn, cloud.xyz - np.array(placement.translation)[:, None, None])
    displacement = np.einsum("ij,jrc->irc", turn, moved.displacement)
    rows = []
    for number, text in enumerate(parameters.gauge, start=1):
        name, place = gauge_from(text)
        covariance = independent_equivalent(
            moved.covariance,
            cloud.covariance,
            averaging_radius_px=moved.averaging_radius_px,
            subset_radius_px=moved.subset_radius_px,
            disc_radius_px=_equal_disc(place) / pitch,
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
        progress(number / len(parameters.gauge), f"read {name}")
    return _Found(rows, np.stack([row.middle for row in rows]))


def _in_image(inputs: Inputs, parameters: GaugesParameters, progress: Progress) -> _Found:
    """Read gauges in the image of a camera alone, where y points up as it does in stored strain."""
    moved = inputs.read(_MOVED_IN_IMAGE, PLANAR_DISPLACEMENT)
    plane = as_surface(moved)
    rows = []
    for number, text in enumerate(parameters.gauge, start=1):
        gauge = described_gauge(text)
        place = _in_pixels(gauge, moved, inputs.subject)
        covariance = independent_equivalent(
            plane.covariance,
            np.zeros_like(plane.covariance),
            averaging_radius_px=0.0,
            subset_radius_px=moved.subset_radius_px,
            disc_radius_px=_equal_disc(place),
        )
        rows.append(
            read_gauge(
                place,
                plane.xyz,
                plane.displacement,
                covariance,
                plane.labels,
                green_lagrange=parameters.measure == "green-lagrange",
            )
        )
        progress(number / len(parameters.gauge), f"read {gauge.name}")
    middle = np.stack([row.middle for row in rows])
    scale = np.nan if moved.mm_per_px is None else moved.mm_per_px
    return _Found(rows, middle * scale, middle[:, :2] * (1.0, -1.0))


def _equal_disc(place: GaugePlace) -> float:
    """Return the radius of the disc that is as large as a grid."""
    return float(np.sqrt(place.length_mm * place.width_mm / np.pi))


def _in_pixels(gauge: DescribedGauge, moved: PlanarDisplacement, subject: Subject) -> GaugePlace:
    """Return a place in pixels, y up; raise `InvalidInput` for one in mm where no scale is known."""
    scale = 1.0
    if gauge.unit == "mm":
        if moved.mm_per_px is None:
            raise InvalidInput(
                f"the displacement of {subject} has no scale, so a place in mm of gauge {gauge.name} means "
                "nothing; write px behind its lengths, or correlate again with mm-per-px"
            )
        scale = 1.0 / moved.mm_per_px
    place = gauge.place
    return GaugePlace(
        scale * place.x_mm,
        -scale * place.y_mm,
        scale * place.length_mm,
        scale * place.width_mm,
        place.angle_rad,
    )


KIND = Kind(
    name="gauges",
    summary="strain that virtual gauges at given places read, from stored displacement",
    version=1,
    scope=Scope.TUPLE,
    parameters=GaugesParameters,
    inputs=(_MOVED, _MOVED_IN_IMAGE, _REFERENCE),
    outputs=(GAUGES,),
    needs=_needs,
    run=run,
    subjects=deformed_images,
    context=specimen_pose,
    in_pipeline=False,
)
