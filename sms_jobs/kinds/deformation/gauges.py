"""Gauges: what virtual strain gauges read on a tuple's stored displacement."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import described_gauge, gauge_from
from sms_jobs.kinds.calibration_factors import States, gauge_sigma, states_of
from sms_jobs.kinds.gauge_errors import errors_of_rectangle
from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_views,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import AT_REST, MOVED
from sms_jobs.kinds.products import CALIBRATION_FACTOR, DISPLACEMENT, GAUGES, REGIONS, SURFACE
from sms_jobs.kinds.surface_ports import surface_port
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch
from sms_jobs.metrology.deformation.strain.gauges import GaugePlace, GaugeValue, read_gauge
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.planes import in_space
from sms_jobs.metrology.geometry.transforms import turn_covariance
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField, Regions, StrainMeasure, Surface
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.reasons import Reason
from sms_jobs.records.remarks import remarked
from sms_jobs.records.scene import AT_ORIGIN
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import GAUGES as GAUGES_GIVEN
from sms_jobs.records.statistic_names import GAUGES_READ
from sms_jobs.records.subject import Subject
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


_MOVED = Port(MOVED, "correlate", (DISPLACEMENT, REGIONS, CALIBRATION_FACTOR))
_REFERENCE = surface_port(AT_REST)


def _needs(campaign: Campaign, subject: Subject, parameters: GaugesParameters) -> Iterable[Need]:
    yield _MOVED.of(subject)
    yield _REFERENCE.of(campaign, replace(subject, state=campaign.reference.label))


def frame_of_gauges(campaign: Campaign, subject: Subject) -> Pose:
    """Return what brings the gauges' frame into that of the surface: the specimen's, or an image's own."""
    return campaign.placement if view_of(subject.view).measures_shape else AT_ORIGIN


def read_by(view: str, gauges: tuple[str, ...]) -> tuple[str, ...]:
    """Return those of described gauges that a view can read: a surface has no pixels."""
    surface = view_of(view).measures_shape
    return tuple(text for text in gauges if not surface or described_gauge(text).unit == "mm")


def run(inputs: Inputs, parameters: GaugesParameters, progress: Progress) -> Iterator[Output]:
    """Fit the stored displacement under each gauge; nothing is correlated again."""
    # Where there are none, the place of the first says what is wrong with it.
    own = read_by(inputs.subject.view or "", parameters.gauge) or parameters.gauge
    parameters = parameters.model_copy(update={"gauge": own})
    moved = inputs.read(_MOVED, DISPLACEMENT)
    regions = inputs.read(_MOVED, REGIONS)
    surface = inputs.read(_REFERENCE.port, SURFACE)
    states = states_of(inputs, _MOVED)
    readings = read_gauges(moved, regions, surface, states, inputs.context, parameters, progress)
    finite = np.isfinite(readings.strain)
    statistics = {GAUGES_GIVEN: float(len(readings.names)), GAUGES_READ: float(finite.sum())}
    if finite.any():
        statistics["largest_gauge_strain"] = float(readings.strain[finite].max())
    nothing = [name for name, known in zip(readings.names, finite, strict=True) if not known]
    if nothing:
        why = "off the specimen, or too few valid points"
        progress(1.0, remarked(f"nothing to read under {', '.join(nothing)}: {why}"))
    yield DatasetOutput(inputs.subject, {GAUGES: readings}, statistics)


def read_gauges(
    moved: DisplacementField,
    regions: Regions,
    surface: Surface,
    states: States | None,
    frame: Pose,
    parameters: GaugesParameters,
    progress: Progress,
) -> GaugeReadings:
    """Return what gauges read; `frame` brings theirs into that of the surface.

    `states` is how well the view is known at the reference state and at this one, None where nobody says.
    Raises `InvalidInput` where a place says nothing on the surface, or a gauge is longer than it.
    """
    places = [place_on(surface, text) for text in parameters.gauge]
    what, most = f"the surface of {surface.view}", across(surface)
    for text, place in zip(parameters.gauge, places, strict=True):
        refuse_longer(described_gauge(text).name, place, what, most, surface.unit)
    labels = np.where(moved.reason == Reason.VALID, regions.labels, 0).astype(np.int32)
    position = in_space(surface.position)
    pitch = pixel_pitch(position, labels, 0.5)
    turn = frame.matrix().T
    position = np.einsum("ij,jrc->irc", turn, position - np.array(frame.translation)[:, None, None])
    displacement = np.einsum("ij,jrc->irc", turn, in_space(moved.displacement))
    green = parameters.measure == "green-lagrange"
    found, parts = [], []
    size, noise = None, np.empty(0)
    for number, place in enumerate(places, start=1):
        if (place.length, place.width) != size:  # of those of one size, which most are, errors are told once
            size = place.length, place.width
            errors = errors_of_rectangle(moved, surface, place.length / pitch, place.width / pitch)
            noise = turn_covariance(turn, errors.every)
        found.append(read_gauge(place, position, displacement, noise, labels, green_lagrange=green))
        if states is not None:
            parts.append(
                gauge_sigma(states, surface, moved, found[-1], frame, place.angle_rad, green_lagrange=green)
            )
        progress(number / len(places), f"read {number} of {number_of(len(places), 'gauge')}")
    part = np.array(parts, dtype=np.float32) if parts else None
    return replace(_readings(found, surface, parameters), sigma_calibration=part)


def across(surface: Surface) -> float:
    """Return the diagonal of the box about the valid points of a surface, in its unit; infinite without."""
    points = np.asarray(surface.position)[:, np.asarray(surface.reason) == Reason.VALID]
    return float(np.linalg.norm(np.ptp(points, axis=1))) if points.size else inf


def refuse_longer(name: str, place: GaugePlace, what: str, most: float, unit: str) -> None:
    """Refuse a gauge that is longer or wider than all that it could lie on; `InvalidInput`."""
    if max(place.length, place.width) > most:
        raise InvalidInput(
            f"gauge {name} is {place.length:g} {unit} long and {place.width:g} {unit} wide, and {what} is "
            f"{most:.4g} {unit} from corner to corner; make the gauge smaller"
        )


def place_on(surface: Surface, text: str) -> GaugePlace:
    """Return where a gauge lies in the unit of a surface; `InvalidInput` where its own says nothing there.

    In an image places are given from the first pixel with y down, and y points up here.
    """
    if surface.has_depth:
        _, place = gauge_from(text)
        return place
    gauge = described_gauge(text)
    scale = 1.0
    if gauge.unit == "px" and surface.mm_per_px is not None:
        scale = surface.mm_per_px
    if gauge.unit == "mm" and surface.unit == "px":
        raise InvalidInput(
            f"the image of {surface.view} has no scale, so a place in mm of gauge {gauge.name} means "
            "nothing; write px behind its lengths, or give the size of a pixel as plane.mm_per_px"
        )
    place = gauge.place
    return GaugePlace(
        scale * place.x, -scale * place.y, scale * place.length, scale * place.width, place.angle_rad
    )


def _readings(found: list[GaugeValue], surface: Surface, parameters: GaugesParameters) -> GaugeReadings:
    """Return what the gauges read, and where their middles are."""
    middle = np.stack([value.middle for value in found])
    size = 1.0 if surface.mm_per_px is None else surface.mm_per_px
    return GaugeReadings(
        parameters.measure,
        tuple(described_gauge(text).name for text in parameters.gauge),
        np.array([value.strain for value in found]),
        np.array([value.sigma for value in found], dtype=np.float32),
        middle if surface.unit == "mm" else np.full_like(middle, np.nan),
        np.array([value.pixels for value in found], dtype=np.int32),
        None if surface.has_depth else middle[:, :2] * (1.0, -1.0) / size,
    )


KIND = Kind(
    name="gauges",
    summary="strain that virtual gauges at given places read, from stored displacement",
    version=9,
    scope=Scope.TUPLE,
    parameters=GaugesParameters,
    inputs=(_MOVED, *_REFERENCE.all),
    outputs=(GAUGES,),
    needs=_needs,
    run=run,
    subjects=deformed_views,
    context=frame_of_gauges,
    along_frame=True,
    in_pipeline=False,
)
