"""`sms rig check`: what each instrument says, and which camera sees which projector."""

from __future__ import annotations

import json
import threading
from datetime import UTC, datetime, timedelta
from math import radians
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.display import COLUMNS, ROWS, display
from support.homes import make_home
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.cli import rig as command
from sms_jobs.errors import DevicesBusy, FrameLost, LinkLost
from sms_jobs.formats.rig_configuration import example_rig, parse_rig
from sms_jobs.instruments.checking import checked
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.connection import connected, connected_stage
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import recorded
from sms_jobs.instruments.recorder import record_state
from sms_jobs.instruments.scanners.link import Address
from sms_jobs.instruments.scanners.server import ScannerServer
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.kinds.kind import rig_queue
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.virtual_rig.campaigns import small_plate


def told(home: Path, *words: str) -> str:
    done = CliRunner().invoke(command.app, [*words, "--home", str(home)])
    if done.exception is not None:
        raise done.exception
    return done.stdout


def connect(home: Path, text: str) -> None:
    make_home(home, {})
    (home / "rig.toml").write_text(text)
    told(home, "add", str(home / "rig.toml"))


def desk(source: str) -> str:
    return f"""
name = "desk"
[[cameras]]
name = "C1"
driver = "opencv"
columns = 64
rows = 48
source = "{source}"
discarded = 0
noise_gain = 0.2
read_noise = 1.5
[[projectors]]
name = "P1"
driver = "window"
columns = {COLUMNS}
rows = {ROWS}
settle_ms = 0.0
"""


def film(folder: Path, levels: list[int]) -> str:
    for number, level in enumerate(levels):
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.full((48, 64), level, np.uint8))
    return str(folder / "%03d.png")


def test_cameras_say_what_they_see_of_each_projector(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The first image is looked at when the camera is connected; then all is dark, then P1 is lit.
    connect(home, desk(film(tmp_path, [9, 12, 200])))
    with display(tmp_path) as hidden:
        monkeypatch.setenv("DISPLAY", hidden.name)
        monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
        found: dict[str, Any] = json.loads(told(home, "check", "desk", "--json"))
        shown = " ".join(told(home, "check", "desk").split())
    assert found["views"] == {"C1": {"dark": 12.0, "P1": 200.0}}
    assert found["sensors"]["P1"] == "display 0, 320 x 200 pixels, SDL driver x11"
    assert found["sensors"]["C1"].endswith("by CV_IMAGES, 64 x 48 pixels of 8 bits, triggered by software")
    assert found["stage"] is None
    assert "sees on average dark 12.0, P1 200.0 of 255" in shown


def test_cameras_without_a_projector_say_what_they_see_now(home: Path, tmp_path: Path) -> None:
    connect(home, desk(film(tmp_path, [9, 120])).partition("[[projectors]]")[0])
    assert json.loads(told(home, "check", "desk", "--json"))["views"] == {"C1": {"now": 120.0}}


def test_a_camera_without_a_frame_fails_the_check(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect(home, desk(film(tmp_path, [9, 12])))
    with display(tmp_path) as hidden:
        monkeypatch.setenv("DISPLAY", hidden.name)
        monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
        with pytest.raises(FrameLost, match="camera C1 delivers no more frames"):
            told(home, "check", "desk")


def test_a_stage_that_has_not_been_home_tells_no_angles(home: Path) -> None:
    connect(home, example_rig())
    found: dict[str, Any] = json.loads(told(home, "check", "virtual", "--json"))
    assert found["stage"] == {"pan_rad": None, "tilt_rad": None, "homed": False}
    assert found["sensors"].keys() == {"C1", "P1", "P2"}
    assert found["views"] == {}
    shown = " ".join(told(home, "check", "virtual").split())
    assert "stage not homed yet, so that it does not know its angles: 'sms rig home virtual'" in shown
    assert "C1 simulated: there when a campaign gives it a scene" in shown


def test_how_patterns_come_is_told(home: Path) -> None:
    pulses = 'pulses = { cameras = ["C1"], period_ms = 20.0 }'
    assert f"# {pulses}" in example_rig()
    connect(home, example_rig().replace(f"# {pulses}", pulses))
    assert json.loads(told(home, "check", "virtual", "--json"))["ways"] == {
        "P1": "patterns played in a burst, one every 20 ms",
        "P2": "patterns shown one by one: the file of rig virtual gives P2 no pulses",
    }
    shown = " ".join(told(home, "check", "virtual").split())
    assert "P1 patterns played in a burst, one every 20 ms" in shown


def test_angles_before_home_are_not_archived(tmp_path: Path) -> None:
    scene = small_plate("plate")[1].scene
    assert scene is not None
    sequence = FringeSequence((2,), 3, (0.0,))
    rig = parse_rig(example_rig().replace("256", "128").replace("384", "192"), "rig.toml")
    for homed in (False, True):
        with connected(rig, Setting(scene, "S00", ()), clock=SimulatedClock()) as found:
            assert found.stage is not None
            if homed:
                found.stage.stage()
            spool = tmp_path / str(homed)
            record_state(found, ("C1P1",), sequence, spool, Limits(), lambda f, words: None)
        assert (recorded(spool, "C1P1", sequence)[1].stage_rad is not None) is homed


def test_simulated_cameras_see_the_light_of_a_scene() -> None:
    scene = small_plate("plate")[1].scene
    assert scene is not None
    rig = parse_rig(example_rig(), "rig.toml")
    with connected(rig, Setting(scene, "S00", ()), clock=SimulatedClock()) as found:
        levels = checked(found).views["C1"]
    assert levels["dark"] == 0.0
    assert min(levels["P1"], levels["P2"]) > 10.0  # of 4095; a plate fills half of the image


def test_a_scanner_without_a_scene_is_only_named(tmp_path: Path) -> None:
    (tmp_path / "key").write_text(f"{bytes(32).hex()}\n")
    lent = parse_rig(example_rig(), "rig.toml")
    server = ScannerServer(lambda: lent, Address("127.0.0.1", 0), bytes(32))
    serving = threading.Thread(target=server.serve)
    serving.start()
    try:
        words = f'driver = "scanner"\nserver = "{server.address}"\nkey_file = "{tmp_path / "key"}"'
        sensor = f'name = "C1"\ncolumns = 256\nrows = 256\n{words}'
        with connected(parse_rig(f'name = "hall"\n[[cameras]]\n{sensor}', "rig", known_sensors())) as found:
            check = checked(found)
    finally:
        server.stop()
        serving.join()
    assert check.views == {}
    assert check.sensors["C1"].startswith(f"scanner at {server.address}")


def test_a_rig_that_somebody_uses_is_left_alone(home: Path) -> None:
    connect(home, example_rig())
    with bootstrap.services(home) as services:
        with services.catalogue.writing() as session:
            now = datetime.now(UTC)
            locks.acquire_for(session, [rig_queue("virtual")], "anna at the rig", now, timedelta(minutes=1))
        for words in (["check"], ["home"], ["move", "--pan", "0", "--tilt", "0"]):
            with pytest.raises(DevicesBusy, match="rig-virtual, which 'anna at the rig' has held"):
                told(home, words[0], "virtual", *words[1:])
        with services.catalogue.writing() as session:
            locks.release(session, holder="anna at the rig")
        told(home, "check", "virtual")
        with services.catalogue.reading() as session:
            assert locks.held_devices(session, datetime.now(UTC)) == []


def test_a_stage_is_moved_without_cameras_and_displays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    sensors = desk("no-such-camera").partition("[[cameras]]")[1:]
    stage = example_rig().partition("[[stages]]")[1:]
    rig = parse_rig("\n".join(['name = "lone"', *sensors, *stage]), "rig.toml", known_sensors())
    with pytest.raises(LinkLost, match="camera C1 cannot be opened"), connected(rig, clock=SimulatedClock()):
        pass
    with connected_stage(rig, SimulatedClock()) as found:
        found.home()
        found.move(0.1, -0.1)
        # It settles within 0.01 degrees, and an encoder has up to 0.0018 degrees a count.
        assert found.known_angles() == pytest.approx((0.1, -0.1), abs=radians(0.012))
