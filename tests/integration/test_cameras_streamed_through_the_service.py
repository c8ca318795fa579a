"""Cameras alone at a rate: streamed by the service, held against the load, kept around an event, killed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from support.command import answer, inside, service, wait_until
from support.deployments import mainly

from sms_jobs import bootstrap
from sms_jobs.app.specimens import campaigns
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.instruments.kept_streams import frames_path
from sms_jobs.instruments.spool import Spooled
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.recording import FramesBetween, Recording
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

RIG = """
name = "pair"
cameras = [
    { name = "C1", driver = "simulated", columns = SIDE, rows = SIDE },
    { name = "C2", driver = "simulated", columns = SIDE, rows = SIDE },
]

[[file_channels]]
name = "load_n"
path = "LOAD"
column = "load"
unit = "kN"
stale_after_s = 10.0
"""
NEEDS_OPERATOR = 5


@pytest.fixture
def environment(request: pytest.FixtureRequest) -> dict[str, str]:
    """Settings of either deployment."""
    own = {"SMS_WORKERS": "1", "SMS_THREADS": "1"}
    if request.param == "embedded":
        return own
    return own | {
        "SMS_DATABASE_URL": request.getfixturevalue("fresh_postgresql_url"),
        "SMS_BROKER_URL": request.getfixturevalue("redis_url"),
    }


@pytest.fixture
def side() -> int:
    """Of the images in px: small, where their size is not what is tried."""
    return 256


@pytest.fixture
def home(tmp_path: Path, environment: dict[str, str], side: int, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    home = tmp_path / "home"
    bootstrap.initialise(home)
    calibration, campaign = stereo_campaign("pair", rig=stereo_rig(side, side))
    campaign = replace(campaign, rig="pair", states=(replace(campaign.states[0], label="t0001"),))
    calibration = replace(calibration, rig=replace(calibration.rig, name="pair"))
    file = home / "rig.toml"
    file.write_text(RIG.replace("SIDE", str(side)).replace('"LOAD"', f"'{home / 'load.csv'}'"))
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
        services.stations.add(file, replace=False)
    return home


@contextmanager
def load_frame(home: Path, load_kn: Callable[[float], float]) -> Iterator[dict[float, float]]:
    """Software of a load frame, which writes the load ten times a second; yields what it wrote, by time."""
    over, written = threading.Event(), dict[float, float]()

    def write() -> None:
        begun = time.time()
        with (home / "load.csv").open("w") as file:
            file.write("time,load\n")
            while True:
                now = time.time()
                written[now] = load_kn(now - begun)
                file.write(f"{now},{written[now]:.6f}\n")
                file.flush()
                if over.wait(0.1):
                    return

    thread = threading.Thread(target=write)
    thread.start()
    while not written:
        time.sleep(0.01)
    try:
        yield written
    finally:
        over.set()
        thread.join()


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


def measured(home: Path) -> dict[str, tuple[Measurement, Recording, dict[str, Any]]]:
    """Return what was measured, by tuple without the campaign; each once."""
    rows = run(home, "data", "find", "--kind", "measurement", "--limit", "1000")
    found = {}
    for row in rows:
        with Archive(FolderStore(home / "archive")).open_unrecorded(row["path"]) as dataset:
            records = {
                name: dataset.read(name, FramesBetween)
                for name in dataset.describe()
                if name.startswith("between")
            }
            counted = {name: (len(r.numbers), r.frames.shape) for name, r in records.items()}
            subject = row["subject"].partition("/")[2]
            assert subject not in found
            measurement = dataset.read("measurement", Measurement)
            np.testing.assert_array_equal(measurement.frames.frame(0), measurement.texture)
            found[subject] = (
                measurement,
                dataset.read("recording", Recording),
                counted,
            )
    return found


@pytest.mark.parametrize("environment", mainly("embedded"), indirect=True)
@pytest.mark.parametrize("side", [1024])
def test_frames_become_states_with_their_loads(home: Path, side: int) -> None:
    with load_frame(home, lambda t: 2.0 * t) as written, service(home):
        done = run(home, "acquire", "stream", "pair", "--rate", "4Hz", "--for", "4s")
        # Cameras that miss the times they are to expose at tell of it, and none is invented.
        assert done["broke_off"] is False
        whole = done["cameras"]["C1"]["whole"]
        assert 2 <= whole <= 16
        for camera in done["cameras"].values():
            assert (camera["states"], camera["lost"], camera["refused"]) == (whole, 0, 0)
            assert camera["moments"] + camera["late"] <= 16
        again = run(home, "acquire", "stream", "pair", "--rate", "4Hz", "--for", "1s", "--every", "3")
        assert (done["first"], again["first"]) == ("t0001", "t2-0001")
        kept = measured(home)
    times, loads = map(np.array, zip(*sorted(written.items()), strict=True))
    labels = [f"t{n:04d}" for n in range(1, whole + 1)]
    with bootstrap.services(home) as services:
        assert [s.label for s in campaigns.definition(services, "pair").states][:whole] == labels
    for camera in ("C1", "C2"):
        of_camera = [kept[f"{label}/{camera}"] for label in labels]
        for measurement, recording, _ in of_camera:
            assert measurement.texture.shape == (side, side)
            # Between the readings next to it the load goes as it does on the whole: 2 kN/s. A file's time is
            # that of its last line but for milliseconds, in which it goes by some newtons.
            at = measurement.recorded_at.timestamp()
            expected_n = 1e3 * np.interp(at, times, loads)
            assert recording.readings()["load_n"] == pytest.approx(expected_n, abs=100.0)
        recorded_at = [measurement.recorded_at for measurement, _, _ in of_camera]
        assert all(a < b for a, b in pairwise(recorded_at))
    # The frames that are no states lie beside the state before them.
    second = sum(counted.get("between_after", (0,))[0] for name, (_, _, counted) in kept.items()
                 if name.startswith("t2-") and name.endswith("/C1"))  # fmt: skip
    assert second + again["cameras"]["C1"]["states"] == again["cameras"]["C1"]["whole"]
    assert not any((home / "spool").iterdir())


@pytest.mark.parametrize("environment", mainly("grown"), indirect=True)
def test_what_is_before_and_after_an_event_is_kept(home: Path) -> None:
    dropped = threading.Event()
    words = ("acquire", "stream", "pair", "--rate", "4Hz", "--before", "2s", "--after", "1s")
    with service(home), load_frame(home, lambda t: 0.0 if dropped.is_set() else 10.0):
        job = run(home, *words, "--for", "1min", "--around", "load_n drops 2kN in 1s", "--no-wait")["jobs"][0]
        wait_until(
            lambda: any("waiting for load_n drops" in one["reason"] for one in run(home, "acquire", "list"))
        )
        time.sleep(3.0)  # frames that are older than what is kept
        dropped.set()
        run(home, "job", "wait", job)
        kept = measured(home)
        missed = inside(*words, "--for", "1s", "--around", "load_n > 50kN", "--home", str(home))
        assert missed.returncode == NEEDS_OPERATOR
        assert "load_n > 50 kN did not come within 1 s, and no frame was kept" in missed.stderr
        (waiting,) = run(home, "acquire", "list")
        assert inside("acquire", "abort", waiting["job_id"], "--home", str(home)).returncode == 0
        assert run(home, "acquire", "list") == []
    assert len(measured(home)) == len(kept)
    since = np.array(
        [
            statistic(home, label, "since_event_s")
            for label in sorted({name.partition("/")[0] for name in kept})
        ]
    )
    assert len(kept) == 2 * len(since)
    # From 2 s before to 1 s after, four a second, but for those that this machine could not take.
    assert since.min() >= -2.0
    assert since.max() <= 1.25
    assert since.min() < -1.0
    assert since.max() > 0.0
    loads = [kept[f"t{n:04d}/C1"][1].readings()["load_n"] for n in range(1, len(since) + 1)]
    assert (loads[0], loads[-1]) == (10_000.0, 0.0)
    assert all(one.channels_after == {} for _, one, _ in kept.values())


@pytest.mark.parametrize("environment", mainly("embedded"), indirect=True)
def test_the_pipeline_runs_on_frames_as_on_any_states(home: Path) -> None:
    with load_frame(home, lambda t: t), service(home):
        done = run(home, "acquire", "stream", "pair", "--rate", "2Hz", "--for", "1500ms", "--process")
        assert (done["first"], done["last"]) == ("t0001", f"t{done['cameras']['C1']['states']:04d}")
        run(home, "job", "wait", "-c", "pair")
    deformed = {f"pair/t{n:04d}/C1C2" for n in range(2, done["cameras"]["C1"]["states"] + 1)}
    assert deformed
    found = run(home, "data", "find", "--kind", "strain", "--columns", "subject,load_n")
    assert {row["subject"] for row in found} == deformed
    # A load of some kilonewtons, in newtons, and greater in the later state.
    loads = [row["load_n"] for row in sorted(found, key=lambda row: str(row["subject"]))]
    assert loads == sorted(loads)
    assert loads[0] > 1000.0


@pytest.mark.parametrize("environment", mainly("grown"), indirect=True)
def test_what_has_reached_the_spool_is_recovered_after_a_kill(home: Path) -> None:
    command = ("acquire", "stream", "pair", "--rate", "4Hz", "--for", "5min", "--no-wait")
    with load_frame(home, lambda t: t):
        with service(home) as up:
            job = run(home, *command)["jobs"][0]
            spool = home / "spool" / job
            while complete(spool) < 5:
                time.sleep(0.1)
            for process in psutil.Process(up.pid).children(recursive=True):
                process.kill()
            while not (found := run(home, "acquire", "list")) or found[0]["state"] != "needs-operator":
                time.sleep(0.2)
            before = complete(spool)
            assert before >= 5
            resumed = run(home, "acquire", "resume", job)
        assert resumed["jobs"] == {"succeeded": 1}
    kept = measured(home)
    assert len(kept) == 2 * before
    assert {name.partition("/")[2] for name in kept} == {"C1", "C2"}


def statistic(home: Path, label: str, name: str) -> float:
    """Return a statistic of the recording of C1 at a state."""
    (row,) = run(home, "data", "find", "--kind", "measurement", "--state", label, "--view", "C1")
    return float(run(home, "data", "show", row["path"])["statistics"][name])


def complete(spool: Path) -> int:
    """Return of how many moments both cameras have a complete frame in a spool."""
    found = []
    for camera in ("C1", "C2"):
        try:
            found.append(Spooled(frames_path(spool, camera)).complete)
        except (FileNotFoundError, ArchiveCorrupt):
            return 0
    return min(found)
