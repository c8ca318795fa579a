"""A campaign of two cameras from the rig to the shape: rehearsed, recorded, broken off, resumed, computed."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command import answer, inside, service, wait_until

from sms_jobs import bootstrap
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.recording import InterruptedRecording, Recording
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

COLUMNS, ROWS = 320, 256
FINDINGS, NEEDS_OPERATOR = 6, 5
RIG = f"""
name = "pair"
cameras = [
    {{ name = "C1", driver = "simulated", columns = {COLUMNS}, rows = {ROWS} }},
    {{ name = "C2", driver = "simulated", columns = {COLUMNS}, rows = {ROWS}, faults = [] }},
]
"""
UNPLUGGED = RIG.replace("faults = []", 'faults = [{ fault = "unplugged", state = "S01" }]')
FLASH = RIG.replace("faults = []", 'faults = [{ fault = "flash", state = "S02", frame = 1 }]')
CALIBRATION, CAMPAIGN = stereo_campaign("pair", rig=stereo_rig(COLUMNS, ROWS))
BOTH = ("C1", "C2")
GAUGES = {"gauges": {"gauge": "g1 x=0 y=0 length=10; far x=500 y=0 length=10"}}


@pytest.fixture
def home(tmp_path: Path) -> Path:
    home = tmp_path / "home"
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        campaign = replace(CAMPAIGN, rig="pair", states=CAMPAIGN.states[:3], processing=GAUGES)
        calibration = replace(CALIBRATION, rig=replace(CALIBRATION.rig, name="pair"))
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
    connect(home, RIG)
    return home


def connect(home: Path, text: str) -> None:
    """Connect the rig, as it now is."""
    (home / "rig.toml").write_text(text)
    with bootstrap.services(home) as services:
        services.stations.add(home / "rig.toml", replace=True)


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


def found(home: Path) -> dict[str, Any]:
    """Return what was measured, by tuple; each once."""
    rows = run(home, "data", "find", "--kind", "measurement")
    files = {row["subject"]: row["path"] for row in rows}
    assert len(files) == len(rows)
    return files


def test_a_campaign_of_two_cameras_is_recorded_and_its_shape_computed(home: Path) -> None:
    rehearsed = run(home, "acquire", "run", "pair", "--dry-run")
    raw = 2 * 2 * COLUMNS * ROWS
    assert (rehearsed["missing"], rehearsed["frames"], rehearsed["raw_bytes"]) == ([], 3 * 2, 3 * raw)
    assert (rehearsed["packed"], rehearsed["archived_bytes"]) == (None, 2 * 3 * raw)
    with service(home):
        done = run(home, "acquire", "run", "pair", "--state", "S00", "--process")
        assert [one["subject"] for one in done["recorded"]] == ["pair/S00/C1", "pair/S00/C2"]
        for one in done["recorded"]:
            statistics = one["statistics"]
            assert statistics["doubts"] == 0.0
            assert statistics["contrast_to_noise"] > 5.0
            assert 0.0 < statistics["apart_ms"] <= 10.0
        assert [s["recording"] for s in run(home, "acquire", "show", "pair")] == ["recorded", "", ""]
        again = run(home, "acquire", "run", "pair", "--missing", "--dry-run")
        assert list(again["states"]) == ["S01", "S02"]
        assert 0.2 < again["packed"] < 2.0
        assert again["archived_bytes"] == round(2 * raw * again["packed"])
        run(home, "job", "wait", "-c", "pair")
        before = run(home, "job", "list", "-c", "pair")
        # What no view can read is refused while it is asked for, as soon as the surface is there.
        for words in (
            ("acquire", "plan", "pair", "--next", "--stop-if", "far.z_mm < 100mm"),
            ("schedule", "add", "nightly", "gauges", "-c", "pair", "--every", "1h"),
        ):
            refused = inside(*words, "--home", str(home))
            assert refused.returncode == 2
            assert "gauge far lies off the surface of C1C2: from its middle at x=500 y=0 mm" in refused.stderr
        assert (run(home, "schedule", "list"), run(home, "acquire", "plan", "show", "pair")) == ([], [])
        assert run(home, "job", "list", "-c", "pair") == before
        # Held after S01, whose gauge has moved, and before S02.
        run(home, "acquire", "plan", "pair", "--next", "--stop-if", "g1.z_mm < 100mm")
        wait_until(
            lambda: any(one["stopped_by"] for one in run(home, "acquire", "plan", "show", "pair")), 60.0
        )
        looks = run(home, "acquire", "plan", "looks", "pair")
        # A quick look shows more than gauges, and one of these can be read.
        run(home, "job", "submit", "quick-look", "-c", "pair", "--state", "S01", "--dry-run")
    files = found(home)
    assert set(files) == {f"pair/{state}/{camera}" for state in ("S00", "S01") for camera in BOTH}
    at_rest, look = looks
    assert [(one["state"], one["view"], one["doubts"]) for one in looks] == [
        ("S00", "C1C2", ""),
        ("S01", "C1C2", "gauge far has no value: too few neighbours"),
    ]
    assert (at_rest["gauges"], look["gauges_lost"]) == ([], 1)
    # Of what shows texture, but for a rim of some px; on half of the image there is none.
    assert all(one["valid_fraction"] > 0.8 for one in looks)
    (gauge,) = look["gauges"]
    assert gauge["name"] == "g1"
    # It moves as a body, so that no gauge grows; 0.003 mm are 0.02 px of the image at both ends.
    assert 0.0 < gauge["extension_sigma_mm"] < 0.005
    assert abs(gauge["extension_mm"]) < 4.5 * gauge["extension_sigma_mm"]
    assert {one["subject"] for one in run(home, "data", "find", "--kind", "stereo")} == {"pair/S00/C1C2"}
    assert CAMPAIGN.scene is not None
    scene = replace(CAMPAIGN.scene, rig=replace(CAMPAIGN.scene.rig, name="virtual-stereo-rig"))
    for view in BOTH:
        expected = SimulatedRig(scene, "S00", (), datetime.now(UTC)).record(view, FringeSequence())
        with Archive(FolderStore(home / "archive")).open_unrecorded(files[f"pair/S00/{view}"]) as dataset:
            measurement = dataset.read("measurement", Measurement)
            np.testing.assert_array_equal(measurement.texture, expected.texture)
            np.testing.assert_array_equal(measurement.frames.frame(0), expected.texture)
            assert measurement.simulation == expected.simulation
            recording = dataset.read("recording", Recording)
    assert (recording.rig, recording.apart_s is None) == ("pair", False)
    assert not any((home / "spool").iterdir())


@pytest.mark.long
def test_what_breaks_off_between_cameras_goes_on_with_both(home: Path) -> None:
    connect(home, UNPLUGGED)
    with service(home):
        done = inside("acquire", "run", "pair", "--state", "S01", "--json", "--home", str(home))
        assert done.returncode == NEEDS_OPERATOR
        assert "camera C2 does not answer; check its cable" in done.stderr
        (waiting,) = run(home, "acquire", "list")
        assert (waiting["subject"], waiting["finished"]) == ("pair/S01", [])
        connect(home, FLASH)
        assert run(home, "acquire", "resume", waiting["job_id"])["jobs"] == {"succeeded": 1}
        job = run(
            home, "job", "submit", "acquire", "-c", "pair", "--state", "S02",
            "--set", "recordings=1", "--set", "doubtful=ask",
        )["jobs"][0]  # fmt: skip
        inside("job", "wait", job, "--home", str(home))
        (asked,) = run(home, "acquire", "list")
        assert asked["finished"] == ["C1", "C2"]
        assert asked["doubts"] == ["C2: 100% of the lit region is saturated, allowed is 2%"]
        connect(home, RIG)  # the lamp is off
        retaken = run(home, "acquire", "resume", job, "--retake")
    assert [v["statistics"]["doubts"] for v in retaken["recorded"]] == [0.0, 0.0]
    files = found(home)
    assert set(files) == {f"pair/{state}/{view}" for state in ("S01", "S02") for view in BOTH}
    for view in BOTH:  # the image of C1, which nobody doubted, was taken again with that of C2
        with Archive(FolderStore(home / "archive")).open_unrecorded(files[f"pair/S02/{view}"]) as dataset:
            assert dataset.read("interrupted_1", InterruptedRecording).frames.shape == (1, ROWS, COLUMNS)


def test_a_rig_that_lacks_a_camera_records_nothing(home: Path) -> None:
    connect(home, "\n".join(line for line in RIG.splitlines() if '"C2"' not in line))
    told = inside("acquire", "run", "pair", "--dry-run", "--home", str(home))
    assert told.returncode == FINDINGS
    assert "the file of rig pair has no C2; it has C1" in " ".join(told.stderr.split())
