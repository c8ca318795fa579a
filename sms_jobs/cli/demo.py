"""`sms demo`: a whole simulated campaign through the real service, compared with the exact truth."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import Enum
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from sqlalchemy.orm import Session

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.cli import output
from sms_jobs.cli.output import Json
from sms_jobs.cli.waiting import succeeded, unsuccessful, wait_for
from sms_jobs.errors import JobFailed, SmsError
from sms_jobs.jobs import chosen, inquiry
from sms_jobs.jobs.planning import PIPELINE, Request
from sms_jobs.jobs.registration import register_campaign
from sms_jobs.jobs.submission import submit_to
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.sensors import Calibration
from sms_jobs.virtual_rig.campaigns import top_hat_bending
from sms_jobs.virtual_rig.sessions import calibration_session

if TYPE_CHECKING:
    from sms_jobs.jobs.calibrations import KnownCalibration


class Size(Enum):
    """Of the simulated cameras: 512 or 1024 px square."""

    SMALL = "small"
    FULL = "full"


def demo(
    size: Annotated[Size, typer.Option(help="Cameras of 512 (small) or 1024 (full) px square.")] = Size.SMALL,
    out: Annotated[Path, typer.Option(help="Folder for catalogue, archive and results.")] = Path("sms-demo"),
    as_json: Json = False,
) -> None:
    """Calibrate a simulated rig and measure a bending test with it, and compare with the exact truth.

    A board and a ball bar are shown to two cameras and two projectors in 31 poses. Then a top-hat profile
    is pushed out at its middle in three steps. Run again in the same folder, every result is reused.

    Example: sms demo --size full --out /tmp/demo
    """
    from sms_jobs.jobs import calibrations  # a second, which every other command would wait for

    started = time.monotonic()
    home = bootstrap.initialise(out.absolute()).home
    session, test = _campaigns(size)
    with bootstrap.services(home) as services:
        for campaign in (session, test):
            _register(services, campaign)
        with _service(home) as still_there:
            # The specimen is recorded while the rig is still being calibrated: its frames do not need that.
            calibrating = _submit(services, session.name, [Request("simulate"), Request(PIPELINE)])
            recording = _submit(services, test.name, [Request("simulate")])
            if not as_json:
                count = len(calibrating) + len(recording)
                output.say(
                    f"calibrating the rig and recording {test.name}: {count} jobs; the service's log is in "
                    f"{home / 'logs'}"
                )
            _succeed(services, [*calibrating, *recording], still_there, home)
            number, _, calibration = calibrations.certify(
                services.catalogue, services.archive, session.name, None, datetime.now(UTC)
            )
            measuring = _submit(services, test.name, [Request(PIPELINE)])
            if not as_json:
                output.say(f"calibration {number} is in use; measuring with it: {len(measuring)} jobs")
            _succeed(services, measuring, still_there, home)
        all_jobs = chosen.named([*calibrating, *recording, *measuring])
        known = calibrations.known_calibration(services.catalogue, services.archive, number)
        with services.catalogue.reading() as reading:
            counted = inquiry.counts(reading, all_jobs)
            summary = {
                "campaign": test.name,
                "home": str(home),
                "jobs": {
                    "succeeded": succeeded(counted),
                    "failed": unsuccessful(counted),
                    "reused": inquiry.reused(reading, all_jobs),
                },
                "seconds": round(time.monotonic() - started, 1),
                "calibration": _calibration(session, known),
                **_accuracy(reading, test.name, calibration),
                **_products(reading, services, test.name),
            }
    if as_json:
        output.print_json(summary)
    else:
        _print_summary(summary)


def _campaigns(size: Size) -> tuple[Campaign, Campaign]:
    """Return the calibration session of the rig, and the test that it measures."""
    _, test = top_hat_bending(f"top-hat-{size.value}", size.value)
    return calibration_session(f"calibration-{size.value}", size.value), test


def _register(services: Services, campaign: Campaign) -> None:
    with services.catalogue.reading() as session:
        known = campaign.name in inquiry.campaign_names(session)
    if not known:
        register_campaign(services.catalogue, services.archive, campaign, None, datetime.now(UTC))


def _submit(services: Services, campaign: str, requests: list[Request]) -> tuple[str, ...]:
    return submit_to(services.catalogue, campaign, requests, datetime.now(UTC)).job_ids


def _succeed(services: Services, ids: Sequence[str], still_there: Callable[[], None], home: Path) -> None:
    """Wait for jobs; raise `JobFailed` unless all succeed."""
    some = chosen.named(ids)
    failures = unsuccessful(wait_for(services.catalogue, some, None, still_there=still_there))
    if failures:
        with services.catalogue.reading() as session:
            last = inquiry.failure(session, some)
        raise JobFailed(f"{failures} jobs of the demo did not succeed; {last} --home {home}")


def _calibration(session: Campaign, known: KnownCalibration) -> dict[str, Any]:
    """Return what the measured calibration is worth, and what it costs against the exact one."""
    from sms_jobs.jobs import calibrations

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


@contextmanager
def _service(home: Path) -> Iterator[Any]:
    """Run `sms up` in a process of its own; yield a function that raises when it has ended."""
    log = home / "logs" / "up.log"
    with log.open("ab") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "sms_jobs.cli.main", "up", "--home", str(home)],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            process_group=0,
        )

    def still_there() -> None:
        if process.poll() is not None:
            raise SmsError(f"the service ended with code {process.returncode}; see {log}")

    try:
        yield still_there
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()


def _accuracy(session: Session, campaign: str, calibration: Calibration) -> dict[str, Any]:
    """Pool the errors of all tuples: every valid pixel counts the same."""
    newest = {
        file.subject: search.statistics(session, file.id)
        for file in reversed(search.find_files(session, source="assess", campaign=campaign, limit=10_000))
    }
    tuples = list(newest.values())
    diagonal = calibration.volume.diagonal_mm
    displacement = _pooled_rms(tuples, "displacement", "_mm")
    return {
        "volume_diagonal_mm": round(diagonal, 3),
        "shape_rms_mm": _pooled_rms(tuples, "shape", "_mm"),
        "displacement_rms_mm": displacement,
        "displacement_relative": displacement / diagonal,
        "strain_rms_microstrain": 1e6 * _pooled_rms(tuples, "strain", ""),
        "valid_fraction": min(_valid_fraction(tuples, "shape"), _valid_fraction(tuples, "displacement")),
        "shape_valid_fraction": _valid_fraction(tuples, "shape"),
        "displacement_valid_fraction": _valid_fraction(tuples, "displacement"),
        "strain_valid_fraction": _valid_fraction(tuples, "strain"),
        "valid_without_truth": int(
            sum(t.get(f"{w}_false_valid_count", 0.0) for t in tuples for w in _FIELDS)
        ),
    }


_FIELDS = ("shape", "displacement", "strain")


def _pooled_rms(tuples: list[dict[str, float]], field: str, unit: str) -> float:
    measured = [t for t in tuples if t.get(f"{field}_count")]
    count = sum(t[f"{field}_count"] for t in measured)
    return sqrt(sum(t[f"{field}_count"] * t[f"{field}_rms{unit}"] ** 2 for t in measured) / count)


def _valid_fraction(tuples: list[dict[str, float]], field: str) -> float:
    measured = [t for t in tuples if t.get(f"{field}_expected_count")]
    count = sum(t[f"{field}_expected_count"] for t in measured)
    return sum(t[f"{field}_expected_count"] * t[f"{field}_valid_fraction"] for t in measured) / count


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


def _print_summary(summary: dict[str, Any]) -> None:
    jobs = summary["jobs"]
    output.print_facts(
        {
            "campaign": summary["campaign"],
            "jobs": f"{jobs['succeeded']} succeeded ({jobs['reused']} reused), {jobs['failed']} failed",
            "took": f"{summary['seconds']:.0f} s",
            "report": summary["report"],
            "exports": f"{len(summary['exports'])} files beside {summary['exports'][0]}",
        }
    )
    diagonal = summary["volume_diagonal_mm"]
    calibration = summary["calibration"]
    poses, session = calibration["poses"], calibration["session"]
    off, expected = 1e3 * calibration["point_error_rms_mm"], 1e3 * calibration["expected_point_rms_mm"]
    held_out, part = 1e3 * calibration["held_out_bar_rms_mm"], 1.0 / calibration["held_out_bar_relative"]
    output.print_facts(
        {
            "calibration": f"{calibration['number']}, of {session}: {poses} poses of board and ball bar",
            "held-out bar lengths": f"{held_out:.1f} um rms, 1/{part:,.0f} of the volume's diagonal",
            "what it costs": f"{off:.1f} um rms at points of the volume; {expected:.1f} um were expected",
        }
    )
    output.print_table(
        ["compared with exact truth", "rms error", "of the volume diagonal", "valid"],
        [
            (
                "shape",
                f"{1e3 * summary['shape_rms_mm']:.1f} um",
                f"1/{diagonal / summary['shape_rms_mm']:,.0f}",
                f"{100 * summary['shape_valid_fraction']:.1f} %",
            ),
            (
                "displacement",
                f"{1e3 * summary['displacement_rms_mm']:.1f} um",
                f"1/{diagonal / summary['displacement_rms_mm']:,.0f}",
                f"{100 * summary['displacement_valid_fraction']:.1f} %",
            ),
            (
                "strain",
                f"{summary['strain_rms_microstrain']:.0f} microstrain",
                None,
                f"{100 * summary['strain_valid_fraction']:.1f} %",
            ),
        ],
        empty="",
    )
