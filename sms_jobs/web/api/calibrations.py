"""Calibrations of rigs: listed, shown, compared, checked, and taken into use."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import Query
from pydantic import Field

from sms_jobs.app.calibrating import calibration_drift, calibration_overview, calibrations
from sms_jobs.app.calibrating.calibration_drift import Drift
from sms_jobs.app.calibrating.calibration_overview import Overview
from sms_jobs.app.calibrating.calibrations import CalibrationText, Decision
from sms_jobs.web.confirming import Confirmed, confirmed
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import FileNumber, Moment, Number, RequestBody, Text
from sms_jobs.web.routes import Routes, answer, returned

ROUTES = Routes("calibrations")


class Certification(Confirmed):
    """The calibration that a session gave, and from when on it is used."""

    session: Annotated[Text, Field(description="Name of the calibration session.")]
    valid_from: Annotated[
        Moment | None, Field(description="With zone; from the session's beginning if not given.")
    ] = None
    despite_warnings: bool = False


class Check(RequestBody):
    """Tuples by whose ray gaps a calibration is checked."""

    tuples: Annotated[list[Text], Field(min_length=1, max_length=100, description="As campaign/state/view.")]
    baseline_mm: Annotated[float, Field(gt=0, le=1000, description="Gap that is usual for the rig.")] = 0.01
    false_alarm: Annotated[float, Field(gt=0, lt=1)] = 0.001


class Use(Confirmed):
    """What a calibration is used for, or no longer."""

    in_use: bool
    campaign: Annotated[Text | None, Field(description="For it alone, in place of the rig.")] = None


@ROUTES.offer(
    "GET",
    "/calibrations",
    calibrations.list_calibrations,
    answers=returned(calibrations.list_calibrations),
)
def list_calibrations(services: Acting, rig: Text | None = None) -> Any:
    """Return calibrations."""
    return answer(calibrations.list_calibrations(services, rig))


@ROUTES.offer("POST", "/calibrations/certify", calibrations.certify)
def certify(services: Acting, body: Certification) -> Any:
    """Take the calibration that a session gave into use."""
    done = calibrations.certify(
        confirmed(services, body), body.session, body.valid_from, despite_warnings=body.despite_warnings
    )
    return answer({"calibration": done.number, "new": done.new, "valid_from": done.valid_from})


@ROUTES.offer("POST", "/calibrations/check", calibrations.check)
def check(services: Acting, body: Check) -> Any:
    """Decide from measurements whether the calibration still holds."""
    return answer(
        calibrations.check(services, body.tuples, baseline_mm=body.baseline_mm, false_alarm=body.false_alarm)
    )


@ROUTES.offer("GET", "/calibrations/compare", calibrations.compare)
def compare(
    services: Acting,
    before: FileNumber,
    after: FileNumber,
    tolerance_mm: Annotated[float | None, Query(ge=0, allow_inf_nan=False)] = None,
) -> Any:
    """Say what changed between two calibrations."""
    return answer(calibrations.compare(services, before, after, tolerance_mm))


@ROUTES.offer("GET", "/calibrations/drift", calibration_drift.drift, answers=Drift)
def drift(services: Acting, rig: Text) -> Any:
    """Return how far a rig has drifted."""
    return answer(calibration_drift.drift(services, rig))


@ROUTES.offer("GET", "/calibrations/{number}", calibration_overview.overview, answers=Overview)
def show(services: Acting, number: Number) -> Any:
    """Return a calibration with what is known of it."""
    return answer(calibration_overview.overview(services, number))


@ROUTES.offer("POST", "/calibrations/{number}/use", calibrations.decide, answers=Decision)
def decide(services: Acting, number: Number, body: Use) -> Any:
    """Decide what a calibration is used for."""
    return answer(calibrations.decide(confirmed(services, body), number, body.campaign, in_use=body.in_use))


@ROUTES.offer("GET", "/calibrations/{number}/export", calibrations.export, answers=CalibrationText)
def export(
    services: Acting,
    number: Number,
    style: Literal[calibrations.STYLES],  # type: ignore[valid-type]
    pixel_pitch_um: Annotated[float, Query(gt=0, le=1000)] = 5.0,
) -> Any:
    """Return a calibration as a file of another program."""
    return answer(calibrations.export(services, number, style, pixel_pitch_um=pixel_pitch_um))
