"""A fatigue-like test on simulated instruments, from the first hold to the report, whatever goes wrong."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select
from support.command import answer, service, sms, wait_until

from sms_jobs import bootstrap
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.scene import Rigid, UniaxialStrain
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import Lens, aimed, small_plate

LOADS_N = (0.0, 400.0, 800.0, 1200.0, 800.0, 0.0, -300.0, -600.0, -300.0, 0.0)
"""Tension, then compression."""

FEW_LOADS_N = (0.0, 400.0, -300.0)
"""The same in short: with one camera and one projector, and fewer things that go wrong."""

VIEWS = ("C1P1", "C1P2", "C2P1", "C2P2")

CAMERAS = """
cameras = [
    { name = "C1", driver = "simulated", columns = 128, rows = 128, faults = [
        { fault = "dropped-frame", state = "S02", frame = 15 },
        { fault = "flash", state = "S04", frame = 3 },
    ] },
    { name = "C2", driver = "simulated", columns = 128, rows = 128, faults = [ #CABLE
    ] },
]
projectors = [
    { name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 10.0 },
    { name = "P2", driver = "simulated", columns = 256, rows = 192, settle_ms = 10.0 },
]
"""
ONE_CAMERA = """
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128, faults = [
    { fault = "dropped-frame", state = "S02", frame = 15 }, #CABLE
] }]
projectors = [{ name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 10.0 }]
"""
RIG = """
name = "bench"
#SENSORS


[[stages]]
name = "stage"
link = { port = "simulated", baud_rate = 38400 }
pan = { module = 12, minimum_deg = -120, maximum_deg = 120, velocity_deg_s = 200, acceleration_deg_s2 = 600 }
tilt = { module = 13, minimum_deg = -108, maximum_deg = 108, velocity_deg_s = 200, acceleration_deg_s2 = 600 }
settling = { timeout_s = 2.0 }
faults = [
    { fault = "hunting-servo", state = "S03", axis = "tilt", amount = 0.002 },
    #SERVO
]

[[file_channels]]
name = "load_n"
path = "LOAD"
column = "load"
unit = "N"
stale_after_s = 30.0

[[channels]]
name = "temperature"
link = { port = "simulated" }
protocol = { terminator = "\\r", reply_terminator = "\\r\\n" }
request = "T?"
reply = '^(?P<value>[-+]?\\d+\\.\\d+)$'
unit = "degC"
faults = [{ fault = "garbled-byte", at = 1 }, { fault = "late-reply", at = 2, amount = 0.3 }]
"""
MEASURED_STATES = select(func.count(FileRow.state_id.distinct())).where(FileRow.source == "measurement")
SERVO = '{ fault = "hunting-servo", state = "S08", amount = 0.002, times = 0 },'
CABLE = '{ fault = "unplugged", state = "S06", frame = 60 },'


@dataclass(frozen=True)
class Plan:
    """A test: its loads, and the sensors before the specimen."""

    loads_n: tuple[float, ...]
    views: tuple[str, ...]
    sensors: str


WHOLE = Plan(LOADS_N, VIEWS, CAMERAS)
SHORT = Plan(FEW_LOADS_N, VIEWS[:1], ONE_CAMERA)


@pytest.fixture
def plan(request: pytest.FixtureRequest) -> Plan:
    assert isinstance(request.param, Plan)
    return request.param


@pytest.fixture
def home(tmp_path: Path, plan: Plan) -> Path:
    """A home with the campaign of a test."""
    home = tmp_path / "home"
    bootstrap.initialise(home)
    calibration, campaign = small_plate("fatigue")
    scene = campaign.scene
    assert scene is not None
    second = aimed("C2", 128, 128, Lens(7.0, -0.08, 0.1, 0.0, 0.0), (200.0, 60.0, 1230.0))
    rig = Rig("bench", (scene.rig.sensors[0], second, *scene.rig.sensors[1:]))
    states = tuple(
        LoadState(
            f"S{number:02d}",
            load,
            # The stage turns from one side to the other between tension and compression.
            channels={"temperature": 21.5, "pan_rad": 0.05 if load < 0.0 else -0.05, "tilt_rad": 0.02},
            deformation=(UniaxialStrain(load * 4e-6, 0.3), Rigid(translation_mm=(load * 5e-4, 0.0, 0.0))),
        )
        for number, load in enumerate(plan.loads_n)
    )
    with bootstrap.services(home) as services:
        register_campaign(
            services.catalogue,
            services.archive,
            replace(campaign, rig="bench", states=states, views=plan.views, scene=replace(scene, rig=rig)),
            replace(calibration, rig=rig),
            datetime.now(UTC),
        )
    return home


def connect(home: Path, plan: Plan, cable: str, servo: str) -> None:
    file = home / "rig.toml"
    text = RIG.replace("#SENSORS", plan.sensors).replace("#CABLE", cable).replace("#SERVO", servo)
    file.write_text(text.replace('"LOAD"', f"'{home / 'load.csv'}'"))
    assert sms("rig", "add", str(file), "--replace", "--home", str(home)).returncode == 0


@pytest.fixture
def load_frame(home: Path, plan: Plan) -> Iterator[None]:
    """Software of a load frame: it ramps to a load, holds it until its state is recorded, and writes it."""
    over = threading.Event()

    def write() -> None:
        load = 0.0
        with bootstrap.services(home) as services, (home / "load.csv").open("w") as file:
            file.write("time,load\n")
            while not over.is_set():
                with services.catalogue.reading() as session:
                    done = session.scalar(MEASURED_STATES) or 0
                target = (*plan.loads_n, 0.0)[done]
                load += max(-100.0, min(100.0, target - load))
                file.write(f"{datetime.now(UTC).isoformat()},{load:.1f}\n")
                file.flush()
                over.wait(0.1)

    thread = threading.Thread(target=write)
    thread.start()
    yield
    over.set()
    thread.join()


def plan_all(home: Path) -> None:
    """Plan every state at its load."""
    options = ("--on", "load_n", "--tolerance", "5N", "--hold", "0.3s", "--process")
    answer("acquire", "plan", "add", "fatigue", *options, "--home", str(home))


def _needs_operator(home: Path, subject: str, why: str) -> str:
    """Wait until a state needs an operator for a reason, and return its job."""

    def waiting() -> list[dict[str, Any]]:
        found = answer("acquire", "list", "--home", str(home))
        return [one for one in found if one["state"] == "needs-operator"]

    (stopped,) = wait_until(waiting, timeout=900.0)
    assert stopped["subject"] == subject
    assert why in stopped["reason"]
    return str(stopped["job_id"])


def _wait_for_the_end(home: Path) -> None:
    """Wait until all that was planned is recorded, and every job has ended."""

    def planned() -> set[str]:
        return {one["status"] for one in answer("acquire", "plan", "show", "fatigue", "--home", str(home))}

    wait_until(lambda: planned() == {"recorded"}, timeout=900.0)
    answer("job", "wait", "-c", "fatigue", "--home", str(home), timeout=1500.0)


def _resume(home: Path, job: str) -> None:
    assert answer("acquire", "resume", job, "--home", str(home))["jobs"] == {"succeeded": 1}


def _all_measured(home: Path, plan: Plan) -> dict[str, Any]:
    """Return the statistics of every measurement: each tuple once, while its load was held."""
    files = answer("data", "find", "-c", "fatigue", "--kind", "measurement", "--home", str(home))
    assert sorted(f["subject"] for f in files) == [
        f"fatigue/S{n:02d}/{view}" for n in range(len(plan.loads_n)) for view in plan.views
    ]
    statistics = {
        f["subject"]: answer("data", "show", str(f["id"]), "--home", str(home))["statistics"] for f in files
    }
    for subject, found in statistics.items():
        load = plan.loads_n[int(subject.split("/")[1][1:])]
        assert abs(found["load_n_before"] - load) <= 5.0
        assert found["temperature_before"] == 21.5  # a garbled reply and a late one were asked for again
        assert found["doubts"] == 0.0
    return statistics


@pytest.mark.parametrize("plan", [SHORT], indirect=True)
def test_a_cable_is_lost_in_an_unattended_test(home: Path, plan: Plan, load_frame: None) -> None:
    connect(home, plan, CABLE.replace("S06", "S01").replace("60", "30"), "")
    plan_all(home)
    with service(home):
        lost = _needs_operator(home, "fatigue/S01", "camera C1 does not answer; check its cable")
        connect(home, plan, "", "")
        _resume(home, lost)
        _wait_for_the_end(home)
    statistics = _all_measured(home, plan)
    assert statistics["fatigue/S02/C1P1"]["retaken_frames"] == 1.0
    strains = answer("data", "find", "-c", "fatigue", "--kind", "strain", "--home", str(home))
    assert {f["subject"] for f in strains} == {"fatigue/S01/C1P1", "fatigue/S02/C1P1"}


@pytest.mark.long
@pytest.mark.parametrize("plan", [WHOLE], indirect=True)
def test_ten_states_are_recorded_and_reported(home: Path, plan: Plan, load_frame: None) -> None:
    connect(home, plan, CABLE, SERVO)
    plan_all(home)
    with service(home):
        # S06 lost a cable and waits, and the servo at S08 hunts; nobody asked the load frame for more.
        lost = _needs_operator(home, "fatigue/S06", "camera C2 does not answer; check its cable")
        connect(home, plan, "", SERVO)
        _resume(home, lost)
        hunting = _needs_operator(
            home, "fatigue/S08", "the servo of 'stage' hunts: after 2 attempts of 2 s pan"
        )
        connect(home, plan, "", "")
        _resume(home, hunting)
        _wait_for_the_end(home)
        report = answer(
            "job", "submit", "report", "-c", "fatigue", "--wait", "--home", str(home), timeout=900.0
        )
    assert report["jobs"] == {"succeeded": 1}
    statistics = _all_measured(home, plan)
    assert statistics["fatigue/S02/C1P1"]["retaken_frames"] == 1.0
    assert statistics["fatigue/S04/C1P1"]["recordings"] == 2.0
    # At S03 the servo hunted once, and stood still when it was told again.
    logs = [log.read_text() for log in (home / "archive" / ".logs" / "jobs").glob("*.log")]
    (mended,) = [text for text in logs if "hunts, attempt 1 of 2" in text and "attempt 2 of 2" not in text]
    assert "fatigue/S03" in mended
    shown = answer("acquire", "show", "fatigue", "--home", str(home))
    assert [(s["recording"], s["views"], s["doubtful"]) for s in shown] == [("recorded", 4, 0)] * len(LOADS_N)
    # Moved by 5e-4 mm a newton, and stretched by 4e-6 from the middle of 75 mm on.
    assert shown[3]["displacement_mm"] > 1200.0 * 5e-4
    assert all(s["processing"] == s["failed"] == 0 for s in shown)
    states = [j["state"] for j in answer("job", "list", "-c", "fatigue", "--home", str(home))]
    assert set(states) == {"succeeded"}
