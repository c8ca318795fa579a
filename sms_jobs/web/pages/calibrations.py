"""Calibrations: how accurate each is, what it is used for, and which a person takes into use."""

from __future__ import annotations

from fastapi.responses import HTMLResponse
from markupsafe import Markup

from sms_jobs.app.calibrating import calibration_drift, calibration_overview, calibrations
from sms_jobs.app.calibrating.calibration_drift import Drift
from sms_jobs.bootstrap import Services
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("calibrations", Entry("Calibrations", "/calibrations", 40))


@PAGES.show("/calibrations", calibrations.list_calibrations)
def list_(page: Page) -> HTMLResponse:
    """List the calibrations, with the drift of each rig."""
    found = calibrations.list_calibrations(page.services)
    rigs = dict.fromkeys(one.rig for one in found)
    return page.render("calibrations.html", found=found, drift=[_drift(page.services, rig) for rig in rigs])


def _drift(services: Services, rig: str) -> tuple[Drift, Markup]:
    """Return the drift of a rig, and its chart."""
    drift = calibration_drift.drift(services, rig)
    return drift, Markup(calibration_drift.drift_chart(drift))  # noqa: S704 - it escapes what it writes


@PAGES.show("/calibrations/{number}", calibration_overview.overview)
def show(page: Page, number: int) -> HTMLResponse:
    """Show a calibration and what speaks for and against it."""
    overview = calibration_overview.overview(page.services, number)
    return page.render(
        "calibration.html",
        calibration=overview,
        view=next(
            one for one in calibrations.list_calibrations(page.services, overview.rig) if one.id == number
        ),
        drift=_drift(page.services, overview.rig),
        distortion=calibrations.distortion(overview.sensors),
        styles=calibrations.STYLES,
    )


@PAGES.show("/certify/{session}", calibrations.certify)
def certify(page: Page, session: str) -> HTMLResponse:
    """Show what a session gave, and ask whether it is taken into use."""
    return page.render("certify.html", candidate=calibration_overview.candidate(page.services, session))
