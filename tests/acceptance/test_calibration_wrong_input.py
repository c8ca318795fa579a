"""Calibrations that cannot be found, used or compared: one sentence, an exit code, and nothing changed."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from support.command import inside
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.jobs.archiving.registration import register_calibration, register_campaign
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import small_plate

USAGE, NOT_FOUND = 2, 3


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of a bar alone, whose rig has never been calibrated, a calibrated plate, another rig."""
    folder = tmp_path_factory.mktemp("uncalibrated")
    whole = small_session("bars")
    bars = replace(whole, states=tuple(s for s in whole.states if s.artefact == "bar"))
    calibration, plate = small_plate("plate")
    binned = tuple(replace(s, columns=s.columns // 2) for s in calibration.rig.sensors)
    other = replace(calibration, rig=Rig("binned", binned))
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("SMS_HOME", raising=False)
        bootstrap.initialise(folder)
        with bootstrap.services(folder) as services:
            register_campaign(services.catalogue, services.archive, bars, None, datetime.now(UTC))
            register_campaign(services.catalogue, services.archive, plate, calibration, datetime.now(UTC))
            register_calibration(services.catalogue, services.archive, other, datetime.now(UTC))
    return folder


@pytest.mark.parametrize(
    ("code", "arguments", "words"),
    [
        # Nothing says where the spheres are, or what their points are worth.
        (NOT_FOUND, ["job", "submit", "simulate", "pipeline", "-c", "bars"], ["calibration", "bars"]),
        (NOT_FOUND, ["calibration", "certify", "bars"], ["bars has given no calibration", "sms job submit"]),
        (NOT_FOUND, ["calibration", "certify", "nobody"], ["nobody"]),
        (
            USAGE,
            ["calibration", "certify", "plate"],
            ["plate is no calibration session", "sms import boards"],
        ),
        (
            USAGE,
            ["calibration", "certify", "bars", "--valid-from", "today"],
            ["a time with its zone", "not 'today'"],
        ),
        (USAGE, ["calibration", "certify", "bars", "--valid-from", "2026-01-01"], ["a time with its zone"]),
        (NOT_FOUND, ["calibration", "compare", "1", "7"], ["7"]),
        (USAGE, ["calibration", "compare", "1", "2"], ["px in the earlier", "those of the same sensors"]),
        (USAGE, ["calibration", "check", "plate"], ["'plate' is no tuple"]),
        (NOT_FOUND, ["calibration", "check", "plate/S00/C1P1"], ["no shape yet"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else str(value),
)
def test_a_command_that_cannot_be_done(home: Path, code: int, arguments: list[str], words: list[str]) -> None:
    done = inside(*arguments, "--home", str(home))
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert len([line for line in done.stderr.strip().splitlines() if line.startswith("error:")]) <= 1
    for word in words:
        assert word in " ".join(done.stderr.split())
