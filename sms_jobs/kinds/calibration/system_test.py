"""System test: errors of reconstructed artefacts, position by position and view by view."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import (
    CALIBRATION,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    tuples,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import SHAPE
from sms_jobs.kinds.products import CALIBRATED, SURFACE, SYSTEM_TEST
from sms_jobs.kinds.surface_ports import position_covariance, surface_port
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.transforms import unpack
from sms_jobs.metrology.surfaces.continuity import continuous_labels
from sms_jobs.metrology.targets.free_fits import Form, FreeSphere, fit_free_plane, fit_free_sphere
from sms_jobs.metrology.targets.sphere_layout import Sphere, SphereLayout
from sms_jobs.metrology.targets.spheres import find_spheres
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject
from sms_jobs.records.system_test import SystemTest, Tested
from sms_jobs.records.views import view_of

_SHAPES = surface_port(SHAPE, several=True)
_RIG = Port("calibration", CALIBRATION, (CALIBRATED,))
_RIM_PX = 3
"""Of a plate, that sees its edge."""
_OF_BAR: tuple[Tested, ...] = ("probing-form", "probing-size", "sphere-distance", "length")
CERTIFIED: dict[Tested, dict[str, float]] = {
    "probing-form": {"form_sigma_mm": 1.0},
    "probing-size": {"radius_sigma_mm": 2.0},
    "sphere-distance": {"length_sigma_mm": 1.0},
    "length": {"length_sigma_mm": 1.0, "radius_sigma_mm": 2.0},
    "flatness": {"form_sigma_mm": 1.0},
}
"""The certificate's uncertainties that an error rests on, by parameter, and how often each is in it."""


class SystemTestParameters(Parameters):
    """Which artefact the states of a campaign show, and what is certified of it."""

    artefact: Literal["ball-bar", "plane"] = Field(description="what every state shows")
    length_mm: float = Field(0.0, ge=0.0, description="certified distance of a bar's spheres")
    length_sigma_mm: float = Field(0.0, ge=0.0, description="its standard uncertainty; 0 is exact")
    radius_mm: float = Field(0.0, ge=0.0, description="certified radius of each sphere")
    radius_sigma_mm: float = Field(0.0, ge=0.0, description="its standard uncertainty; 0 is exact")
    form_sigma_mm: float = Field(
        0.0,
        ge=0.0,
        description="standard uncertainty of the artefact's own form: roundness, or flatness; 0 is exact",
    )
    largest_left_out: float = Field(
        0.003,
        ge=0.0,
        lt=0.5,
        description="part of a feature's points that may lie off its surface and be left out; where more "
        "do, the position has no value",
    )

    @model_validator(mode="after")
    def _bar_is_known(self) -> Self:
        if self.artefact == "ball-bar" and not (0.0 < 2.0 * self.radius_mm < self.length_mm):
            raise ValueError(
                f"the certificate of a ball bar has length_mm above twice radius_mm, not {self.length_mm:g} "
                f"and {self.radius_mm:g} mm"
            )
        return self


@dataclass(frozen=True)
class _Row:
    """One value, or why there is none."""

    quantity: Tested
    subject: Subject
    error: float = float("nan")
    noise: float = float("nan")
    certified: float = float("nan")
    points: int = 0
    left_out: int = 0
    missing: str = ""


def _needs(campaign: Campaign, subject: Subject, parameters: SystemTestParameters) -> Iterable[Need]:
    yield _RIG.of(Subject(campaign.name))
    for each in tuples(campaign):
        yield _SHAPES.of(campaign, each)


def _subjects(campaign: Campaign) -> Iterable[Subject]:
    return (Subject(campaign.name),) if "system-test" in campaign.processing else ()


def run(inputs: Inputs, parameters: SystemTestParameters, progress: Progress) -> Iterator[Output]:
    """Measure every tuple by itself: nothing is averaged over views or positions."""
    rows: list[_Row] = []
    subjects = [one for one in inputs.about(_SHAPES.port) if one.view is not None]
    for number, subject in enumerate(subjects):
        surface = inputs.read(_SHAPES.port, SURFACE, subject)
        if parameters.artefact == "plane":
            rows.append(_plane_row(surface, subject, parameters, inputs.threads))
        else:
            camera = inputs.read(_RIG, CALIBRATED).rig.sensor(view_of(subject.view).camera)
            rows += _bar_rows(surface, subject, camera.pose.centre(), parameters, inputs.threads)
        progress((number + 1) / (len(subjects) + 1), f"measured {subject}")
    test = _record(rows, parameters)
    yield DatasetOutput(inputs.subject, {SYSTEM_TEST: test}, _statistics(test))


def _bar_rows(
    surface: Surface, subject: Subject, camera: Floats, parameters: SystemTestParameters, threads: int
) -> list[_Row]:
    known = surface.reason == Reason.VALID
    covariance = position_covariance(surface)
    sigma = np.where(known, np.sqrt(trace(covariance)), np.nan)
    points = np.where(known, surface.position, np.nan)
    found = find_spheres(
        points,
        sigma,
        parameters.radius_mm,
        camera,
        layout=SphereLayout(bar_length_mm=parameters.length_mm),
        threads=threads,
    )
    off = [_left_out(sphere) for sphere in found.spheres]
    count = [len(sphere.pixels) for sphere in found.spheres]
    problem = ""
    if len(found.spheres) != 2 or found.problems:
        problem = "; ".join(found.problems) or f"{len(found.spheres)} of 2 spheres were found"
    elif max(o / (o + c) for o, c in zip(off, count, strict=True)) > parameters.largest_left_out:
        problem = _too_many(max(off), parameters)
    if problem:
        return [
            _Row(name, subject, points=sum(count), left_out=sum(off), missing=problem) for name in _OF_BAR
        ]
    alike = float((2 * surface.subset_radius_px + 1) ** 2)
    first, second = found.spheres
    free = [_free(sphere, surface, covariance, alike) for sphere in found.spheres]
    return _values(subject, (first, second), (free[0], free[1]), alike, parameters)


def _left_out(sphere: Sphere) -> int:
    """Count the points that lie off a sphere's surface and belong to no other thing that joins it."""
    return sphere.refused["in front of the surface"] + sphere.refused["behind the surface"]


def _too_many(count: int, parameters: SystemTestParameters) -> str:
    part = f"{100.0 * parameters.largest_left_out:g} %"
    return f"{count} points of a feature lie off its surface, more than the {part} that may be left out"


def _free(sphere: Sphere, surface: Surface, covariance: NDArray[np.floating], alike: float) -> FreeSphere:
    row, column = sphere.pixels.T
    points = surface.position[:, row, column].T
    own = unpack(covariance[:, row, column].astype(np.float64))
    return fit_free_sphere(points, own, sphere.centre, sphere.radius, alike)


def _values(
    subject: Subject,
    spheres: tuple[Sphere, Sphere],
    free: tuple[FreeSphere, FreeSphere],
    alike: float,
    parameters: SystemTestParameters,
) -> list[_Row]:
    """Return the errors of a bar: of form and size the worse sphere's."""
    points = sum(len(sphere.pixels) for sphere in spheres)
    off = sum(map(_left_out, spheres))
    apart = spheres[1].centre - spheres[0].centre
    distance = float(np.linalg.norm(apart))
    along = apart / distance
    spread = float(np.sqrt(alike * (along @ (spheres[0].covariance + spheres[1].covariance) @ along)))
    form = max((one.form for one in free), key=lambda one: one.span)
    size = max(free, key=lambda one: abs(one.radius - parameters.radius_mm))
    radii = free[0].radius + free[1].radius
    row = _Row("probing-form", subject, points=points, left_out=off)
    noise_of_length = float(np.sqrt(spread**2 + free[0].radius_sigma ** 2 + free[1].radius_sigma ** 2))
    return [
        _with_form(row, form, parameters),
        replace(
            row,
            quantity="probing-size",
            error=2.0 * (size.radius - parameters.radius_mm),
            noise=2.0 * size.radius_sigma,
            certified=_certified_sigma("probing-size", parameters),
        ),
        replace(
            row,
            quantity="sphere-distance",
            error=distance - parameters.length_mm,
            noise=spread,
            certified=_certified_sigma("sphere-distance", parameters),
        ),
        replace(
            row,
            quantity="length",
            error=distance + radii - parameters.length_mm - 2.0 * parameters.radius_mm,
            noise=noise_of_length,
            certified=_certified_sigma("length", parameters),
        ),
    ]


def _plane_row(surface: Surface, subject: Subject, parameters: SystemTestParameters, threads: int) -> _Row:
    """Return the flatness error of the largest piece of surface, less its rim."""
    known = surface.reason == Reason.VALID
    covariance = position_covariance(surface)
    sigma = np.where(known, np.sqrt(trace(covariance)), np.nan)
    labels = continuous_labels(np.where(known, surface.position, np.nan), sigma, threads=threads)
    inner = ndimage.binary_erosion(labels == 1, np.ones((3, 3)), iterations=_RIM_PX)
    points = surface.position[:, inner].T
    own = unpack(covariance[:, inner].astype(np.float64))
    row = _Row("flatness", subject, points=len(points))
    try:
        form, used = fit_free_plane(points, own)
    except InvalidInput as error:
        return replace(row, missing=str(error))
    off = int(np.count_nonzero(~used))
    row = replace(row, points=form.points, left_out=off)
    if off > parameters.largest_left_out * len(points):
        return replace(row, missing=_too_many(off, parameters))
    return _with_form(row, form, parameters)


def _with_form(row: _Row, form: Form, parameters: SystemTestParameters) -> _Row:
    certified = _certified_sigma(row.quantity, parameters)
    return replace(row, error=form.span, noise=form.span_sigma, certified=certified)


def _certified_sigma(quantity: Tested, parameters: SystemTestParameters) -> float:
    rests_on = CERTIFIED[quantity].items()
    return float(np.hypot.reduce([times * getattr(parameters, name) for name, times in rests_on]))


def _record(rows: list[_Row], parameters: SystemTestParameters) -> SystemTest:
    form = parameters.form_sigma_mm
    certificate = f"form within {form:g} mm" if form > 0.0 else "form taken as exact"
    if parameters.artefact == "ball-bar":
        certificate = (
            f"distance of spheres {_certified(parameters.length_mm, parameters.length_sigma_mm)}, radius "
            f"{_certified(parameters.radius_mm, parameters.radius_sigma_mm)}, {certificate}"
        )
    noise, certified = np.array([r.noise for r in rows]), np.array([r.certified for r in rows])
    return SystemTest(
        parameters.artefact,
        f"{certificate} (standard uncertainties)",
        tuple(r.quantity for r in rows),
        tuple(r.subject.state or "" for r in rows),
        tuple(r.subject.view or "" for r in rows),
        tuple(r.missing for r in rows),
        np.array([r.error for r in rows]),
        np.hypot(noise, certified),
        certified,
        np.array([r.points for r in rows], np.int64),
        np.array([r.left_out for r in rows], np.int64),
    )


def _certified(value_mm: float, sigma_mm: float) -> str:
    return f"{value_mm:g} mm " + (f"± {sigma_mm:g} mm" if sigma_mm > 0.0 else "taken as exact")


def _statistics(test: SystemTest) -> dict[str, float]:
    """Return what people search by: the largest error of each quantity, and how many values are missing."""
    found = {"missing_values": float(sum(map(bool, test.missing)))}
    for name in dict.fromkeys(test.quantities):
        own = np.abs(test.error[[one == name for one in test.quantities]])
        if np.isfinite(own).any():
            found[f"largest_{name.replace('-', '_')}_error_mm"] = float(np.nanmax(own))
    return found


KIND = Kind(
    name="system-test",
    summary="errors of form, size, distance, length or flatness of an artefact with a certificate",
    version=1,
    scope=Scope.CAMPAIGN,
    parameters=SystemTestParameters,
    inputs=(_RIG, *_SHAPES.all),
    outputs=(SYSTEM_TEST,),
    needs=_needs,
    run=run,
    subjects=_subjects,
    in_pipeline=False,
)
