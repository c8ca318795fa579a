"""Tests of measuring systems against certified artefacts: planned, and judged."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from sms_jobs.app.calibrating import system_tests
from sms_jobs.app.calibrating.system_tests import BarCertificate, PlannedPosition, PlateCertificate
from sms_jobs.records.shown.system_tests import SystemVerdict
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import RequestBody, Text, Texts
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("calibrations")

_Size = Annotated[float, Field(gt=0, le=1e6, description="In mm.")]
_Sigma = Annotated[float, Field(ge=0, le=1e6, description="Standard uncertainty in mm; 0 is exact.")]


class Bar(RequestBody):
    """Certificate of a ball bar."""

    length_mm: _Size
    length_sigma_mm: _Sigma
    radius_mm: _Size
    radius_sigma_mm: _Sigma
    form_sigma_mm: _Sigma


class Plate(RequestBody):
    """Certificate of a flat plate."""

    width_mm: _Size
    height_mm: _Size
    form_sigma_mm: _Sigma


class NewTest(RequestBody):
    """A test of a rig by a bar, a plate, or both."""

    rig: Text
    name: Annotated[Text, Field(description="Of the campaigns: NAME-bar and NAME-plate.")]
    bar: Bar | None = None
    plate: Plate | None = None
    like: Annotated[
        Text | None, Field(description="A campaign of the rig whose views and virtual scene are taken.")
    ] = None


class Judged(RequestBody):
    """Campaigns of a test, and the limits that it is judged by."""

    campaigns: Annotated[Texts, Field(min_length=1)]
    limits: Annotated[
        dict[Text, _Size], Field(max_length=20, description="Largest error that is allowed, by quantity.")
    ]
    risk: Annotated[
        float, Field(gt=0, lt=0.5, description="Largest probability that a decision is wrong.")
    ] = 0.05


@ROUTES.offer("POST", "/calibrations/tests", system_tests.plan, answers=list[PlannedPosition], status=201)
def plan(services: Acting, body: NewTest) -> Any:
    """Create the campaigns of a test."""
    bar = None if body.bar is None else BarCertificate(**body.bar.model_dump())
    plate = None if body.plate is None else PlateCertificate(**body.plate.model_dump())
    return answer(system_tests.plan(services, body.rig, body.name, bar, plate, body.like), 201)


@ROUTES.offer("POST", "/calibrations/tests/judge", system_tests.judge, answers=SystemVerdict)
def judge(services: Acting, body: Judged) -> Any:
    """Judge the errors of a test."""
    return answer(system_tests.judge(services, body.campaigns, body.limits, body.risk))
