"""States recorded with instruments: whatever breaks off, nothing is lost or asked for twice."""

from __future__ import annotations

import socket
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from sqlalchemy import select
from support.command import answer, service, sms, wait_until
from support.spools import complete_frames

from sms_jobs import bootstrap
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.instruments.spool import Spooled
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.recording import recordings
from sms_jobs.records.job import JobState
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.recording import InterruptedRecording, Recording
from sms_jobs.virtual_rig.campaigns import small_plate

RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [
    { name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 40.0 },
    { name = "P2", driver = "simulated", columns = 256, rows = 192, settle_ms = 40.0 },
]

[[channels]]
name = "load_n"
link = { port = "simulated" }
protocol = { terminator = "\\r", reply_terminator = "\\r\\n" }
request = "L?"
reply = '(?P<value>[-+]?\\d+(?:\\.\\d*)?)'
unit = "N"
faults = [{ fault = "garbled-byte", at = 2 }]
"""
FRAMES = 41  # 2 orientations of 5 densities of 4 steps, and white
SLOW = RIG.replace("settle_ms = 40.0", "settle_ms = 100.0")
UNPLUGGED = RIG.replace(
    "rows = 128 }", 'rows = 128, faults = [{ fault = "unplugged", state = "S01", frame = 60 }] }'
)
FLASH = RIG.replace("rows = 128 }", 'rows = 128, faults = [{ fault = "flash", frame = 3 }] }')


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home with two campaigns on one rig, whose file is there."""
    home = tmp_path / "home"
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        for name in ("plate", "other"):
            calibration, campaign = small_plate(name)
            register_campaign(
                services.catalogue,
                services.archive,
                replace(campaign, rig="bench"),
                replace(calibration, rig=replace(calibration.rig, name="bench")),
                datetime.now(UTC),
            )
    rig(home, RIG)
    return home


def rig(home: Path, text: str) -> None:
    """Connect a rig, as it now is."""
    file = home / "rig.toml"
    file.write_text(text)
    with bootstrap.services(home) as services:
        services.stations.add(file, replace=True)


def recorded_files(home: Path) -> list[str]:
    """Return the paths of what was measured."""
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        return list(session.scalars(select(FileRow.path).where(FileRow.source == "measurement")))


def measurements(home: Path) -> dict[str, Measurement]:
    """Return everything that was measured, by tuple; each tuple once."""
    archive, found = Archive(FolderStore(home / "archive")), {}
    for path in recorded_files(home):
        with archive.open_unrecorded(path) as dataset:
            assert str(dataset.subject) not in found
            measurement = dataset.read("measurement", Measurement)
            frames = np.stack([measurement.frames.frame(k) for k in range(measurement.frames.shape[0])])
            found[str(dataset.subject)] = replace(measurement, frames=frames)  # type: ignore[arg-type]
    return found


def spooled(home: Path) -> int:
    """Return how many complete frames of the second projector are in a spool."""
    return complete_frames(home, "C1P2")


@pytest.mark.long
def test_a_state_is_recorded_and_processed(home: Path) -> None:
    with service(home):
        done = run(home, "acquire", "run", "plate", "--process")
        assert done["jobs"] == {"succeeded": 2}
        run(home, "job", "wait", "-c", "plate")
        checked = run(home, "rig", "check", "bench")
    assert checked["channels"] == {"load_n": 0.0}
    assert [v["subject"] for v in done["recorded"]] == [
        f"plate/{s}/{p}" for s in ("S00", "S01") for p in ("C1P1", "C1P2")
    ]
    assert all(v["statistics"]["doubts"] == 0.0 for v in done["recorded"])
    # One reply was garbled on the way; the question was asked again.
    assert done["recorded"][2]["statistics"]["load_n_before"] == 1200.0
    assert not any((home / "spool").iterdir())
    states = {j["state"] for j in run(home, "job", "list", "-c", "plate")}
    assert states == {"succeeded"}
    assert "plate/S01/C1P1" in {r["subject"] for r in run(home, "data", "find", "--kind", "strain")}
    with Archive(FolderStore(home / "archive")).open_unrecorded(
        next(r["path"] for r in run(home, "data", "find", "--kind", "measurement"))
    ) as dataset:
        assert dataset.names == ("measurement", "recording")
        recording = dataset.read("recording", Recording)
    assert recording.rig == "bench"
    assert len(recording.times_s) == FRAMES
    # A pattern needs 40 ms to be on; nothing can be faster.
    assert np.diff(recording.times_s).min() >= 0.04


def has_begun(home: Path) -> bool:
    """Tell whether a process of a worker listens, whatever it serves."""
    return any("Connected to" in log.read_text("utf-8") for log in (home / "logs").glob("worker-*.log"))


def test_a_killed_worker_loses_no_complete_frame(home: Path) -> None:
    (home / "rigs" / "bench.toml").unlink()
    with bootstrap.services(home) as services:
        # Looked at from here: a command for each look would take most of the time of this test.
        def submitted() -> str:
            with services.catalogue.writing() as session:
                return submit(
                    session, "plate", [Request("acquire", {}, ("S01",))], datetime.now(UTC)
                ).job_ids[0]

        def opened() -> list[recordings.OpenRecording]:
            with services.catalogue.reading() as session:
                return recordings.open_recordings(session, home / "spool")

        def needs_operator() -> bool:
            return [r.state for r in opened()] == [JobState.NEEDS_OPERATOR]

        def seen_from_another_host() -> recordings.OpenRecording:
            with services.catalogue.reading() as session:
                return recordings.open_recordings(session, home / "another spool")[0]

        with service(home) as supervisor:
            job = submitted()
            # A rig that is connected later is served by the worker that runs.
            wait_until(lambda: has_begun(home))
            rig(home, SLOW)
            wait_until(lambda: spooled(home) > 10)
            seen = spooled(home)
            _kill_recorder(supervisor)
            wait_until(needs_operator)
            (waiting,) = opened()
            assert waiting.finished == ("C1P1",)
            assert (waiting.host, waiting.here) == (socket.gethostname(), True)
            away = seen_from_another_host()
            assert (away.host, away.here, away.finished) == (waiting.host, False, ())
            assert "cannot be asked for twice" in waiting.reason
            assert waiting.reason.endswith(f"then 'sms acquire resume {job[:8]}'")
            with services.catalogue.reading() as session:
                assert not locks.held_devices(session, datetime.now(UTC))
            kept = spooled(home)
            assert seen <= kept < FRAMES
            first = Spooled(next((home / "spool").glob("*/C1P1.*.frames")))
            before = np.stack([first.frame(k) for k in range(FRAMES - 1)]), first.header.recorded_at
            # Nothing goes on by itself; somebody has looked and says so.
            resumed = run(home, "acquire", "resume", job[:8])
            assert resumed["jobs"] == {"succeeded": 1}
    found = measurements(home)
    assert set(found) == {"plate/S01/C1P1", "plate/S01/C1P2"}
    np.testing.assert_array_equal(found["plate/S01/C1P1"].frames, before[0])
    assert found["plate/S01/C1P1"].recorded_at == before[1]  # it was not recorded twice
    (broken,) = interrupted(home)
    assert len(broken) == kept
    # The virtual rig shows the same whenever it is asked: what broke off began like what was recorded.
    np.testing.assert_array_equal(broken, found["plate/S01/C1P2"].frames[: len(broken)])
    assert not any((home / "spool").iterdir())


def interrupted(home: Path) -> list[np.ndarray]:
    """Return the frames of the sets that broke off."""
    archive, found = Archive(FolderStore(home / "archive")), []
    for path in recorded_files(home):
        with archive.open_unrecorded(path) as dataset:
            for name in dataset.names:
                if name.startswith("interrupted"):
                    broken = dataset.read(name, InterruptedRecording)
                    count = broken.frames.shape[0]
                    found.append(np.stack([broken.frames.frame(k) for k in range(count)]))
    return found


def _kill_recorder(supervisor: psutil.Process) -> None:
    """Kill whichever processes below the supervisor write to the spool."""
    for process in supervisor.children(recursive=True):
        if any("spool" in f.path for f in process.open_files()):
            process.kill()
            return
    raise AssertionError("nobody writes to the spool")


@pytest.mark.long
def test_an_unplugged_cable_waits_for_an_operator(home: Path) -> None:
    rig(home, UNPLUGGED)
    with service(home):
        done = sms("acquire", "run", "plate", "--json", "--home", str(home))
        assert done.returncode == 5
        assert "camera C1 does not answer; check its cable" in done.stderr
        (waiting,) = run(home, "acquire", "list")
        assert (waiting["subject"], waiting["state"], waiting["finished"]) == (
            "plate/S01",
            "needs-operator",
            ["C1P1"],
        )
        rig(home, RIG)  # plugged in again
        assert run(home, "acquire", "resume", waiting["job_id"])["jobs"] == {"succeeded": 1}
    assert len(measurements(home)) == 4
    assert len(interrupted(home)) == 1


@pytest.mark.long
def test_a_doubtful_set_is_asked_about_while_the_specimen_is_held(home: Path) -> None:
    rig(home, FLASH)
    with service(home):
        # A lamp shone into the camera: the set is recorded again by itself, and is good then.
        again = run(home, "acquire", "run", "plate", "--state", "S00")
        assert [v["statistics"]["recordings"] for v in again["recorded"]] == [2.0, 1.0]
        job = run(
            home, "job", "submit", "acquire", "-c", "other", "--state", "S00",
            "--set", "recordings=1", "--set", "doubtful=ask",
        )["jobs"][0]  # fmt: skip
        sms("job", "wait", job, "--home", str(home))
        (waiting,) = run(home, "acquire", "list")
        assert waiting["state"] == "needs-operator"
        assert waiting["doubts"] == ["C1P1: 100% of the lit region is saturated, allowed is 2%"]
        rig(home, RIG)  # the lamp is off
        done = run(home, "acquire", "resume", job, "--retake")
    assert [v["statistics"]["doubts"] for v in done["recorded"]] == [0.0, 0.0]
    refused = sms("acquire", "resume", job, "--home", str(home))
    assert refused.returncode == 4


@pytest.mark.long
def test_an_aborted_recording_goes_on_where_it_stopped(home: Path) -> None:
    # A command that is started on a busy machine is to find it still recording.
    rig(home, RIG.replace("settle_ms = 40.0", "settle_ms = 400.0"))
    with service(home):
        job = run(home, "acquire", "run", "plate", "--state", "S00", "--no-wait")["jobs"][0]
        wait_until(lambda: spooled(home) > 5)
        assert sms("acquire", "abort", "--home", str(home)).returncode == 0
        wait_until(lambda: run(home, "job", "list", "-c", "plate")[0]["state"] == "cancelled")
        assert run(home, "acquire", "resume", job)["jobs"] == {"succeeded": 1}
    assert len(measurements(home)) == 2
    nothing = sms("acquire", "abort", "--home", str(home))
    assert nothing.returncode == 4
    assert "no recording runs" in nothing.stderr
