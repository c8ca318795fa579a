"""The demo: a whole simulated campaign through the real service, compared with the exact truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from math import sqrt
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from sqlalchemy.orm import Session

from sms_jobs.app.rules import use_case
from sms_jobs.app.work.waiting import Waited, Waiting, wait_for
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import JobFailed
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning import chosen
from sms_jobs.jobs.planning.graph import PIPELINE, Request
from sms_jobs.jobs.planning.submission import Terms, submit_to
from sms_jobs.jobs.running.remarks import remarks
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.people import Right
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.shown.remarks import Remarks
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import ErrorsOf, of_errors
from sms_jobs.virtual_rig.campaigns import top_hat_bending
from sms_jobs.virtual_rig.sessions import calibration_session

if TYPE_CHECKING:
    from sms_jobs.jobs.archiving.calibrations import KnownCalibration

Size: TypeAlias = Literal["small", "full"]
"""Of the simulated cameras: 512 or 1024 px square."""


@use_case(Right.COMPUTE)
def run(
    services: Services, size: Size, *, say: Callable[[str], None], tell: Callable[[Waiting], None]
) -> tuple[dict[str, Any], tuple[Remarks, ...]]:
    """Calibrate a simulated rig and measure a bending test with it, and compare with the exact truth.

    A service has to run in the home. Run again, every result is reused.

    Parameters
    ----------
    say
        Called with sentences that say what is being done.
    tell
        Called again and again while jobs run; may raise to end the waiting.

    Returns
    -------
    What came of it, with units in the names, and what its jobs remark about their data.

    Raises
    ------
    JobFailed
        A job did not succeed.
    """
    from sms_jobs.jobs.archiving import (  # a second, for which nobody who lists commands should wait
        calibrations,
    )

    began, started = datetime.now(UTC), time.monotonic()
    session, test = _campaigns(size)
    for campaign in (session, test):
        _register(services, campaign)
    # The specimen is recorded while the rig is still being calibrated: its frames do not need that.
    calibrating = _submit(services, session.name, [Request("simulate"), Request(PIPELINE)])
    recording = _submit(services, test.name, [Request("simulate")])
    count = len(calibrating) + len(recording)
    say(
        f"calibrating the rig and recording {test.name}: {number_of(count, 'job')}; the service's log is in "
        f"{services.settings.log_folder}"
    )
    _succeed(services, [*calibrating, *recording], tell)
    number, _, calibration = calibrations.certify(
        services.catalogue, services.archive, session.name, None, datetime.now(UTC)
    )
    measuring = _submit(services, test.name, [Request(PIPELINE)])
    say(f"calibration {number} is in use; measuring with it: {number_of(len(measuring), 'job')}")
    _succeed(services, measuring, tell)
    all_jobs = chosen.by_ids([*calibrating, *recording, *measuring])
    known = calibrations.known_calibration(services.catalogue, services.archive, number)
    with services.catalogue.reading() as reading:
        done = Waited(inquiry.counts(reading, all_jobs))
        summary = {
            "campaign": test.name,
            "home": str(services.settings.home),
            "jobs": {
                "succeeded": done.succeeded,
                "failed": done.failures,
                "reused": inquiry.reused(reading, all_jobs),
            },
            "seconds": round(time.monotonic() - started, 1),
            "calibration": _calibration(session, known),
            **_accuracy(reading, test.name, calibration),
            **_products(reading, services, test.name),
        }
        return summary, remarks(reading, all_jobs, began)


def _campaigns(size: Size) -> tuple[Campaign, Campaign]:
    """Return the calibration session of the rig, and the test that it measures."""
    _, test = top_hat_bending(f"top-hat-{size}", size)
    return calibration_session(f"calibration-{size}", size), test


def _register(services: Services, campaign: Campaign) -> None:
    with services.catalogue.reading() as session:
        known = campaign.name in inquiry.campaign_names(session)
    if not known:
        register_campaign(services.catalogue, services.archive, campaign, None, datetime.now(UTC))


def _submit(services: Services, campaign: str, requests: list[Request]) -> tuple[str, ...]:
    now, terms = datetime.now(UTC), Terms(by=services.actor.name)
    return submit_to(services.catalogue, campaign, requests, now, terms).job_ids


def _succeed(services: Services, ids: Sequence[str], tell: Callable[[Waiting], None]) -> None:
    """Wait for jobs; raise `JobFailed` unless all succeed."""
    waited = wait_for(services, chosen.by_ids(ids), tell=tell)
    if waited.failures:
        home = services.settings.home
        raise JobFailed(
            f"{number_of(waited.failures, 'job')} of the demo did not succeed; {waited.failure} --home {home}"
        )


def _calibration(session: Campaign, known: KnownCalibration) -> dict[str, Any]:
    """Return how accurate the measured calibration is, and what it costs against the exact one."""
    from sms_jobs.jobs.archiving import calibrations

    assert session.scene is not None
    assert known.quality is not None
    off = calibrations.deviation_from(session.scene.rig, known.calibration)
    expected = known.quality.expected_sigma
    return {
        "number": known.number,
        "session": session.name,
        "poses": len(session.states),
        "held_out_bar_rms_mm": known.quality.held_out_bar_rms_mm(),
        "held_out_bar_relative": known.quality.held_out_bar_rms_mm() / known.calibration.volume.diagonal_mm,
        "expected_point_rms_mm": float(np.sqrt(np.nanmean(expected**2))),
        "point_error_rms_mm": float(np.sqrt(np.mean(np.square(list(off.values()))))),
    }


def _accuracy(session: Session, campaign: str, calibration: Calibration) -> dict[str, Any]:
    """Pool the errors of all tuples: every valid pixel counts the same."""
    newest = {
        file.subject: search.statistics(session, file.id)
        for file in reversed(search.find_files(session, source="assess", campaign=campaign, limit=10_000))
    }
    tuples = list(newest.values())
    diagonal = calibration.volume.diagonal_mm
    displacement = _pooled_rms(tuples, "displacement")
    return {
        "volume_diagonal_mm": round(diagonal, 3),
        "shape_rms_mm": _pooled_rms(tuples, "shape"),
        "displacement_rms_mm": displacement,
        "displacement_relative": displacement / diagonal,
        "strain_rms_microstrain": 1e6 * _pooled_rms(tuples, "strain"),
        "valid_fraction": min(_valid_fraction(tuples, "shape"), _valid_fraction(tuples, "displacement")),
        "shape_valid_fraction": _valid_fraction(tuples, "shape"),
        "displacement_valid_fraction": _valid_fraction(tuples, "displacement"),
        "strain_valid_fraction": _valid_fraction(tuples, "strain"),
        "valid_without_truth": int(
            sum(t.get(of_errors(w, "false_valid_count"), 0.0) for t in tuples for w in _FIELDS)
        ),
    }


_FIELDS: tuple[ErrorsOf, ...] = ("shape", "displacement", "strain")


def _pooled_rms(tuples: list[dict[str, float]], field: ErrorsOf) -> float:
    count, rms = of_errors(field, "count"), of_errors(field, "rms")
    measured = [t for t in tuples if t.get(count)]
    return sqrt(sum(t[count] * t[rms] ** 2 for t in measured) / sum(t[count] for t in measured))


def _valid_fraction(tuples: list[dict[str, float]], field: ErrorsOf) -> float:
    count, valid = of_errors(field, "expected_count"), of_errors(field, "valid_fraction")
    measured = [t for t in tuples if t.get(count)]
    return sum(t[count] * t[valid] for t in measured) / sum(t[count] for t in measured)


def _products(session: Session, services: Services, campaign: str) -> dict[str, Any]:
    reports = search.find_files(session, source="report", campaign=campaign, limit=1)
    exports = {
        (file.subject, file.media_type): file.path
        for file in reversed(search.find_files(session, source="export", campaign=campaign, limit=10_000))
    }
    return {
        "report": services.archive.location(reports[0].path),
        "exports": [services.archive.location(path) for path in exports.values()],
    }
