"""A rehearsal says how long a recording takes, and the recording takes as long, on the rig's clock."""

from __future__ import annotations

from dataclasses import replace
from math import radians
from pathlib import Path

import pytest

from sms_jobs.formats.rig_configuration import parse_rig
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.devices.device import POLLS_EVERY_S
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.recorder import record_state
from sms_jobs.instruments.recording_sets import Adaptation, Patterns
from sms_jobs.instruments.rehearsal import rehearse
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.kinds.recording.adaptation import QUICK
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import RigFile
from sms_jobs.records.scene import Scene
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import Lens, aimed, small_plate

VIEWS = ("C1P1", "C2P1", "C1P2", "C2P2")
SEQUENCE = FringeSequence((8, 7), 3, exposures=(0.5, 1.0))
POSES = (StagePose(0.3, -0.2), StagePose(-0.3, 0.1), StagePose(0.0, 0.0))
RIG = """
name = "virtual"
cameras = [
    { name = "C1", driver = "simulated", columns = 128, rows = 128 },
    { name = "C2", driver = "simulated", columns = 96, rows = 64 },
]
projectors = [
    { name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 40.0 },
    { name = "P2", driver = "simulated", columns = 256, rows = 192, settle_ms = 60.0 },
]

[[stages]]
name = "stage"
link = { port = "PORT", baud_rate = 38400 }
faults = [{ fault = "hunting-servo", times = 0 }]

[[triggers]]
name = "box"
link = { port = "PORT-box" }
protocol = { prefix = "@", checksum = "sum" }
wiring = [{ sensor = "C1", output = 1 }, { sensor = "C2", output = 2 }]
trigger = "{output}T"

[[splitters]]
name = "splitter"
link = { port = "PORT-splitter" }
protocol = { terminator = ">", reply_terminator = ">", accepted = "^[A-Z]{2}", refused = "^ERR(?P<error>.*)" }
wiring = [{ sensor = "P1", output = 1 }, { sensor = "P2", output = 2 }]
select = "VS{output}"
settle_s = 0.5

[[channels]]
name = "load_n"
link = { port = "PORT-load" }
protocol = { terminator = "\\r", reply_terminator = "\\r\\n" }
request = "L?"
reply = '(?P<value>[-+]?\\d+(?:\\.\\d*)?)'
unit = "N"
"""


def rig(port: str, *changes: tuple[str, str]) -> RigFile:
    text = RIG.replace('"PORT', f'"{port}') if port != "simulated" else ""
    if port == "simulated":
        text = "".join(
            'link = { port = "simulated" }\n' if line.startswith('link = { port = "PORT-') else line
            for line in RIG.splitlines(keepends=True)
        ).replace('"PORT"', '"simulated"')
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return parse_rig(text, "rig.toml", known_sensors())


def scene() -> Scene:
    plain = small_plate("plate")[1].scene
    assert plain is not None
    second = aimed("C2", 96, 64, Lens(7.0, -0.08, 0.1, 0.0, 0.0), (200.0, 60.0, 1230.0))
    return replace(plain, rig=Rig("virtual", (plain.rig.sensors[0], second, *plain.rig.sensors[1:])))


def test_a_recording_takes_as_long_as_was_said(tmp_path: Path) -> None:
    steady = rig("simulated", ('faults = [{ fault = "hunting-servo", times = 0 }]', ""))
    foretold = rehearse(steady, VIEWS, SEQUENCE, POSES, texture_exposure=0.5)
    for pose, said in zip(POSES, foretold, strict=True):
        clock = SimulatedClock()
        with connected(steady, Setting(scene(), "S00", ()), clock=clock) as found:
            assert found.stage is not None
            found.stage.stage()
            found.stage.set(pose).wait()
            moved = clock.monotonic()
            if pose is POSES[0]:
                record_state(
                    found, VIEWS, SEQUENCE, tmp_path / "s", Limits(), lambda *_: None, texture_exposure=0.5
                )
                took = clock.monotonic() - moved
        # Homing of either axis, the move and its settling are waited for in steps of their own.
        assert moved == pytest.approx(said.moving_s, abs=4 * POLLS_EVERY_S)
        # The same messages and pauses. Either switching of the video is waited for in steps, of which
        # rounding may add one; and angles, read on both axes for each of 4 sets, have up to 6 stuffed bytes.
        assert took == pytest.approx(said.recording_s, abs=2 * POLLS_EVERY_S + 8 * 6 * 10 / 38400)
        assert said.frames == len(VIEWS) * 25
        assert said.raw_bytes == 2 * 25 * 2 * (128 * 128 + 96 * 64)
        assert said.set_bytes == said.raw_bytes // 2
    # Nothing is shorter than the projectors' delays, and there was more than that.
    assert took > 25 * (0.04 + 0.06) + 2 * 0.5


def test_a_pre_exposure_is_counted() -> None:
    as_planned = Adaptation(QUICK, lambda projector, quick: Patterns(SEQUENCE))
    plain = rehearse(rig("simulated"), VIEWS, SEQUENCE, (None,))
    adaptive = rehearse(rig("simulated"), VIEWS, SEQUENCE, (None,), adaptation=as_planned)
    assert adaptive[0].frames == plain[0].frames
    # Each projector shows 36 patterns more, of 40 and 60 ms; triggers and exposures come to it.
    assert adaptive[0].recording_s - plain[0].recording_s > 36 * (0.04 + 0.06)


def test_a_stage_on_a_wire_looks_for_home_once() -> None:
    simulated, wired = (rehearse(rig(port), VIEWS, SEQUENCE, POSES) for port in ("simulated", "/dev/ttyS8"))
    assert wired[0].moving_s == pytest.approx(simulated[0].moving_s)
    homing = simulated[1].moving_s - wired[1].moving_s
    # Out to the switch at -0.3 rad and back, each axis after the other, at 20 degrees/s.
    assert homing > 2 * 0.3 / radians(20.0)


def test_a_pose_out_of_reach_is_told() -> None:
    far = rehearse(rig("simulated"), VIEWS, SEQUENCE, (StagePose(0.0, 2.5), None))
    assert "the tilt axis of 'stage' is sent to 2.5000 rad, beyond its range" in far[0].problem
    assert not far[1].problem


def test_an_exposure_counts_once_for_all_cameras() -> None:
    class Slow(type(rig("simulated").cameras[0])):  # type: ignore[misc]
        exposure_ms = 20.0

    plain = rig("simulated")
    slow = replace(plain, cameras=tuple(Slow(c.name, c.columns, c.rows, "simulated") for c in plain.cameras))
    before, after = (rehearse(r, VIEWS, SEQUENCE, (None,))[0] for r in (plain, slow))
    # 12 frames of half an exposure, 12 of a whole one, and the white one, at each of two projectors.
    assert after.recording_s - before.recording_s == pytest.approx(2 * (12 * 0.5 + 12 + 1) * 0.02)
