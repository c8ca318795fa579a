"""Two scanners with computers of their own, and a client: they record what one computer would."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.errors import ConfigurationError, FrameLost, InvalidInput, LinkLost
from sms_jobs.formats.rig_configuration import parse_rig
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import finished_sets, interrupted, recorded
from sms_jobs.instruments.recorder import record_state
from sms_jobs.instruments.scanners.keys import made_key, read_key
from sms_jobs.instruments.scanners.link import Address, ScannerLink
from sms_jobs.instruments.scanners.server import Lent, ScannerServer
from sms_jobs.instruments.simulated.optics import Setting, SimulatedCamera
from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import RigFile
from sms_jobs.records.scene import PanTilt, Rigid, Scene
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import Lens, aimed, small_plate

VIEWS = ("C1P1", "C2P1", "C1P2", "C2P2")
SEQUENCE = FringeSequence((8, 7), 3, exposures=(0.5, 1.0))
FRAMES = 24
KEY = bytes(range(32))
SIZES = {"C1": (128, 128), "C2": (96, 64), "P1": (256, 192), "P2": (256, 192)}


def scene() -> Scene:
    plain = small_plate("plate")[1].scene
    assert plain is not None
    second = aimed("C2", 96, 64, Lens(7.0, -0.08, 0.1, 0.0, 0.0), (200.0, 60.0, 1230.0))
    return replace(plain, rig=Rig("virtual", (plain.rig.sensors[0], second, *plain.rig.sensors[1:])))


def rig_file(name: str, cameras: dict[str, str], projectors: dict[str, str], more: str = "") -> RigFile:
    """Return a rig with the sensors that are named, each with what belongs to its driver."""
    lines = [f'name = "{name}"']
    for what, sensors in (("cameras", cameras), ("projectors", projectors)):
        for sensor, driver in sensors.items():
            columns, rows = SIZES[sensor]
            lines += [f'[[{what}]]\nname = "{sensor}"\ncolumns = {columns}\nrows = {rows}', driver]
    return parse_rig("\n".join([*lines, more]), f"{name}.toml", known_sensors())


@dataclass
class Served:
    """The servers of two scanners, and what their client knows of them."""

    key: Path
    servers: dict[str, ScannerServer] = field(default_factory=dict)
    threads: list[threading.Thread] = field(default_factory=list)

    def start(self, number: int, camera: str = "", port: int = 0) -> None:
        """Serve camera and projector of a number."""
        file = rig_file(
            f"scanner-{number}",
            {f"C{number}": f'driver = "simulated"\n{camera}'},
            {f"P{number}": 'driver = "simulated"\nsettle_ms = 1.0'},
        )
        server = ScannerServer(lambda: file, Address("127.0.0.1", port), KEY)
        thread = threading.Thread(target=server.serve)
        thread.start()
        self.servers[str(number)] = server
        self.threads.append(thread)

    def client(self, more: str = "") -> RigFile:
        """Return the rig of both, as the client has it."""
        by = {
            n: f'driver = "scanner"\nserver = "{s.address}"\nkey_file = "{self.key}"'
            for n, s in self.servers.items()
        }
        return rig_file(
            "hall", {f"C{n}": d for n, d in by.items()}, {f"P{n}": d for n, d in by.items()}, more
        )

    def stop(self) -> None:
        for server in self.servers.values():
            server.stop()
        for thread in self.threads:
            thread.join()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    key = tmp_path / "key"
    key.write_text(KEY.hex() + "\n")
    found = Served(key)
    yield found
    found.stop()


def record(rig: RigFile, spool: Path, setting: Setting | None = None) -> None:
    with connected(rig, setting or Setting(scene(), "S00", ())) as found:
        record_state(found, VIEWS, SEQUENCE, spool, Limits(), lambda *_: None)


def test_two_scanners_record_what_one_computer_would(served: Served, tmp_path: Path) -> None:
    served.start(1)
    served.start(2)
    record(served.client(), tmp_path / "s")
    seen = SimulatedRig(scene(), "S00", (), RealClock().now())
    for view in VIEWS:
        measurement, recording = recorded(tmp_path / "s", view, SEQUENCE)
        expected = seen.record(view, SEQUENCE)
        assert measurement.simulation == expected.simulation
        np.testing.assert_array_equal(measurement.texture, expected.texture)
        for k in range(FRAMES):
            np.testing.assert_array_equal(measurement.frames.frame(k), expected.frames.frame(k))
        assert recording.verdict.doubts == ()
        # Times are the client's, in order, and nothing was taken before the recording began.
        assert recording.times_s[0] > 0.0
        assert (np.diff(recording.times_s) >= 0.001).all()  # a picture takes so long to be on


def test_cameras_of_two_scanners_see_the_lamp_at_one_moment(served: Served, tmp_path: Path) -> None:
    served.start(1)
    served.start(2)
    cameras, limits = ("C1", "C2"), Limits(lit_fraction=0.0, apart_s=1.0)
    with connected(served.client(), Setting(scene(), "S00", ())) as found:
        record_state(found, cameras, SEQUENCE, tmp_path / "s", limits, lambda *_: None)
    seen = SimulatedRig(scene(), "S00", (), RealClock().now())
    for view in cameras:
        measurement, recording = recorded(tmp_path / "s", view, SEQUENCE)
        np.testing.assert_array_equal(measurement.texture, seen.record(view, SEQUENCE).texture)
        assert recording.verdict.doubts == ()
        # Light is computed once both were exposed.
        assert recording.apart_s is not None
        assert 0.0 < recording.apart_s < 0.5


def test_what_the_stage_of_the_client_moves_is_seen_by_all(served: Served, tmp_path: Path) -> None:
    served.start(1)
    served.start(2)
    stage = """
    [[stages]]
    name = "stage"
    link = { port = "simulated", baud_rate = 115200 }
    """
    told = Setting(scene(), "S00", (PanTilt(0.0, 0.0), Rigid()))
    # A stage that was not brought home yet stands at 0.2 rad on both axes.
    record(served.client(stage), tmp_path / "s", told)
    measurement, _ = recorded(tmp_path / "s", "C2P1", SEQUENCE)
    assert measurement.simulation is not None
    turned = measurement.simulation.deformation
    assert turned[0] == PanTilt(0.2, 0.2)
    expected = SimulatedRig(scene(), "S00", turned, RealClock().now()).record("C2P1", SEQUENCE)
    np.testing.assert_array_equal(measurement.frames.frame(5), expected.frames.frame(5))


def test_a_frame_that_a_scanner_loses_is_taken_again(served: Served, tmp_path: Path) -> None:
    served.start(1)
    served.start(2, 'faults = [{ fault = "flash", frame = 7 }]')
    record(served.client(), tmp_path / "s")
    assert [recorded(tmp_path / "s", p, SEQUENCE)[1].recordings for p in VIEWS] == [2, 2, 1, 1]


def test_a_scanner_that_is_gone_loses_nothing_that_was_complete(served: Served, tmp_path: Path) -> None:
    served.start(1)
    served.start(2, f'faults = [{{ fault = "unplugged", frame = {FRAMES + 1 + 10} }}]')
    with pytest.raises(LinkLost, match="camera C2 does not answer; check its cable"):
        record(served.client(), tmp_path / "s")
    assert [p for p in VIEWS if p in finished_sets(tmp_path / "s")] == ["C1P1", "C2P1"]
    gone = served.servers["2"]
    gone.stop()
    served.threads[1].join()
    with pytest.raises(LinkLost, match=r"there is no server of a scanner at 127\.0\.0\.1"):
        record(served.client(), tmp_path / "s")
    served.start(2, port=gone.address.port)
    record(served.client(), tmp_path / "s")
    assert all(view in finished_sets(tmp_path / "s") for view in VIEWS)
    assert [len(interrupted(tmp_path / "s", view, SEQUENCE)) for view in VIEWS] == [0, 0, 1, 1]


def test_a_server_that_ends_meanwhile_is_named(served: Served, tmp_path: Path) -> None:
    served.start(1)
    served.start(2)

    def end(fraction: float, words: str) -> None:
        if fraction > 0.7:
            served.servers["1"].stop()
            served.threads[0].join()

    with (
        pytest.raises(LinkLost, match=f"{served.servers['1'].address} does not answer"),
        connected(served.client(), Setting(scene(), "S00", ())) as found,
    ):
        record_state(found, VIEWS, SEQUENCE, tmp_path / "s", Limits(), end)
    assert [p for p in VIEWS if p in finished_sets(tmp_path / "s")] == ["C1P1", "C2P1"]


def test_requests_that_make_no_sense_are_answered(served: Served) -> None:
    served.start(1)
    server = served.servers["1"].address
    with closing(ScannerLink(server, KEY, RealClock(), Setting(scene(), "S00", ()))) as link:
        assert set(link.facts["cameras"]) == {"C1"}
        with pytest.raises(InvalidInput, match="there is no request 'fly'"):
            link.ask("fly")
        with pytest.raises(InvalidInput, match="scanner scanner-1 has no C9; it has C1"):
            link.ask("arm", camera="C9", exposure=1.0)
        link.tell("trigger", camera="C9")
        with pytest.raises(InvalidInput, match="has no C9"):  # told with the next answer
            link.ask("time")
        assert link.ask("time")[0]["time_s"] > 0.0


def test_a_scanner_is_lent_to_one_client_at_a_time(served: Served) -> None:
    served.start(1)
    server = served.servers["1"].address
    with closing(ScannerLink(server, KEY, RealClock(), None)):
        began = time.monotonic()
        with pytest.raises(LinkLost, match="is lent to another client"):
            ScannerLink(server, KEY, RealClock(), None)
        assert time.monotonic() - began < 30.0  # it does not wait for the other to end
    # Those who gave up are not waited for.
    with closing(ScannerLink(server, KEY, RealClock(), None)) as link:
        assert link.ask("time")[0]["time_s"] > 0.0


def test_a_scanner_whose_client_is_gone_rests() -> None:
    file = rig_file("scanner", {"C1": 'driver = "simulated"'}, {"P1": 'driver = "simulated"'})
    with connected(file, Setting(scene(), "S00", ())) as rig:
        lent = Lent(rig, rig.clock)
        lent.obey({"command": "arm", "camera": "C1", "exposure": 1.0})
        lent.obey({"command": "show", "projector": "P1", "number": -1})
        camera = rig.cameras["C1"]
        assert isinstance(camera, SimulatedCamera)
        assert camera.room.view("C1", 1.0).any()
        lent.rest()
        assert not camera.room.view("C1", 1.0).any()
        camera.trigger()  # one that is not armed takes nothing
        with pytest.raises(FrameLost):
            camera.read(0.0)


def test_a_key_is_made_once_and_for_its_owner(tmp_path: Path) -> None:
    path = tmp_path / "rigs" / "left.key"
    key = made_key(path)
    assert len(key) == 32
    assert path.stat().st_mode & 0o077 == 0
    assert made_key(path) == read_key(path) == key
    with pytest.raises(ConfigurationError, match="cannot be read from"):
        read_key(tmp_path / "nowhere")
    path.write_text("a word that somebody thought of")
    with pytest.raises(ConfigurationError, match="holds no key of 64 hexadecimal digits but 31 bytes"):
        read_key(path)


def test_sizes_that_contradict_the_scanner_are_refused(served: Served, tmp_path: Path) -> None:
    served.start(1)
    served.start(2)
    wrong = served.client()
    wrong = replace(wrong, cameras=(replace(wrong.cameras[0], rows=100), *wrong.cameras[1:]))
    with pytest.raises(InvalidInput, match=r"C1 has 128 x 128 px at .* and 128 x 100 px in the rig file"):
        record(wrong, tmp_path / "s")


@pytest.mark.parametrize("text", ["", "host", ":7411", "host:port", "host:70000"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput, match="is no address of a server"):
        Address.parse(text)
