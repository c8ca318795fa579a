"""DLPC900 projectors: bytes as published, and a controller behind them that shows what it is told."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import pi
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.dlpc900 import Peer, decoded

from sms_jobs.errors import DeviceFault, FrameLost, InvalidInput, LinkLost
from sms_jobs.formats.rig_configuration import parse_rig
from sms_jobs.instruments.bursts import Players, played
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.codecs import dlpc900 as codec
from sms_jobs.instruments.optical_drivers import DriverContext
from sms_jobs.instruments.pictures import grey_levels, pattern_brightness
from sms_jobs.instruments.projectors.dlpc900 import Controller, Dlpc900Projector, Dlpc900Settings, connect
from sms_jobs.instruments.protocols import CameraFacts, Frame
from sms_jobs.instruments.transports.hid_device import HidDevice
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.records.bursts import Burst, PulseTrain
from sms_jobs.records.gray_code import GrayCode
from sms_jobs.records.measurement import FringeSequence

COLUMNS, ROWS = 200, 140
SETTINGS = Dlpc900Settings("P1", COLUMNS, ROWS, "dlpc900", "/dev/hidraw7", pattern_ms=10.0, settle_ms=40.0)
SEQUENCE = FringeSequence((5, 4), 3, gray=GrayCode(3, (5.0,)))
BURST = Burst(SEQUENCE.frames, 1.0, 0.015, 0.0, 0.0125)


@pytest.fixture
def peer() -> Peer:
    return Peer(SimulatedClock())


def opened(peer: Peer) -> Dlpc900Projector:
    projector = Dlpc900Projector(SETTINGS, Controller("P1", peer, peer.clock), peer.clock)
    projector.connect()
    return projector


def picture(number: int, sequence: FringeSequence = SEQUENCE) -> NDArray[np.uint8]:
    brightness = pattern_brightness(sequence, number, COLUMNS, ROWS)
    return np.broadcast_to(grey_levels(brightness, 1.0), (ROWS, COLUMNS))


def hexadecimal(data: bytes) -> str:
    return data.hex(" ")


def test_messages_are_as_published() -> None:
    # DLPU018, tables 1-5 to 1-7, without the number of the report; a write asks for an answer besides.
    assert hexadecimal(codec.message(0x1100, None, 0x11)) == "c0 11 02 00 00 11"
    colour = bytes.fromhex("ff 01 ff 01 ff 01")
    assert hexadecimal(codec.message(0x1100, colour, 0x12)) == "40 12 08 00 00 11 ff 01 ff 01 ff 01"
    answer = bytes.fromhex("c0 11 06 00 ff 01 ff 01 ff 01").ljust(64, b"\0")
    assert codec.reply(answer) == codec.Reply(0x11, False, colour)
    assert codec.reply(bytes([0xE0, 0x11, 0, 0]).ljust(64, b"\0")) == codec.Reply(0x11, True, b"")
    assert codec.reply(b"") is None
    assert codec.reply(bytes([0xC0, 0x11, 200, 0]).ljust(64, b"\0")) is None  # more than came


def test_a_long_message_goes_by_several_reports() -> None:
    sent = codec.reports(codec.message(codec.Command.IMAGE_DATA, bytes(range(200)), 3))
    assert [len(one) for one in sent] == [64] * 4
    assert b"".join(sent)[6:206] == bytes(range(200))
    assert not any(b"".join(sent)[206:])


def test_an_example_of_patterns_that_are_loaded_is_as_published() -> None:
    # DLPU018, section 5.3: a red pattern of 1 bit for 200 us, a green one of 2 bits for 400 us.
    red = codec.Pattern(0, 0, 0, 200, bits=1, light=1)
    green = codec.Pattern(1, 0, 1, 400, bits=2, light=2)
    assert hexadecimal(codec.definition(red)) == "00 00 c8 00 00 11 00 00 00 00 00 00"
    assert hexadecimal(codec.definition(green)) == "01 00 90 01 00 23 00 00 00 00 00 08"
    assert hexadecimal(codec.patterns(2)) == "02 00 00 00 00 00"
    assert hexadecimal(codec.announced(0, 6057)) == "00 00 a9 17 00 00"
    parts = codec.pieces(bytes(6057))
    assert len(parts) == 13
    assert {hexadecimal(part[:2]) for part in parts[:-1]} == {"f8 01"}
    assert hexadecimal(parts[-1]) == "09 00" + " 00" * 9
    assert (codec.ON_THE_FLY, codec.START) == (b"\3", b"\2")


@pytest.mark.parametrize("columns", [2, 127, 128, 300])
def test_images_are_what_they_were(columns: int, rng: np.random.Generator) -> None:
    rows = 9
    any_levels = rng.integers(0, 256, (3, rows, columns), dtype=np.uint8)
    across = np.broadcast_to(any_levels[:, :1], any_levels.shape)
    down = np.broadcast_to(any_levels[:, :, :1], any_levels.shape)
    for levels in (any_levels, across, down, np.zeros_like(any_levels)):
        image = codec.image(levels)
        pixels = decoded(image)
        for place in range(3):
            np.testing.assert_array_equal(pixels >> 8 * place & 255, levels[place])
    # Lines that are alike take six bytes at most, a copy of so many pixels and the end of the line.
    assert len(codec.image(across)) <= 48 + 3 + 3 * columns + 2 + 6 * (rows - 1) + 3 + 3


def test_every_pattern_is_shown_pixel_for_pixel(peer: Peer) -> None:
    projector = opened(peer)
    projector.load(SEQUENCE)
    assert SEQUENCE.frames == 24
    assert peer.loaded == list(reversed(range(9)))  # three in each, and white in the last
    assert peer.shown() is None
    begun = peer.clock.monotonic()
    for number in range(SEQUENCE.frames):
        projector.show(number)
        np.testing.assert_array_equal(peer.shown(), picture(number))
    assert peer.clock.monotonic() == pytest.approx(begun + SEQUENCE.frames * 0.04)
    projector.white()
    np.testing.assert_array_equal(peer.shown(), 255)
    projector.dark()
    assert peer.shown() is None
    with pytest.raises(IndexError):
        projector.show(SEQUENCE.frames)


def test_white_is_there_before_any_sequence(peer: Peer) -> None:
    projector = opened(peer)
    projector.dark()
    projector.white()
    np.testing.assert_array_equal(peer.shown(), 255)


def test_it_plays_all_patterns_in_order(peer: Peer) -> None:
    projector = opened(peer)
    projector.load(SEQUENCE)
    loads = peer.commands.count(codec.Command.IMAGE_DATA)
    for burst in (BURST, replace(BURST, period_s=0.03, lit_s=0.025)):
        projector.play(burst)
        shown = peer.played()
        assert [(one.lit_us, one.lit_us + one.dark_us) for one in shown] == [
            (round(1e6 * burst.lit_s), round(1e6 * burst.period_s))
        ] * SEQUENCE.frames
        for number, one in enumerate(shown):
            np.testing.assert_array_equal(one.levels, picture(number))
        begun = peer.clock.monotonic()
        projector.wait()
        assert peer.clock.monotonic() == pytest.approx(begun + burst.seconds)
        projector.dark()
    projector.show(4)
    np.testing.assert_array_equal(peer.shown(), picture(4))
    assert {data[2:5] for data in peer.defined.values()} == {(10_000).to_bytes(3, "little")}
    projector.load(replace(SEQUENCE, exposures=(0.5, 1.0)))  # the same patterns
    assert peer.commands.count(codec.Command.IMAGE_DATA) == loads
    projector.load(replace(SEQUENCE, orientations_rad=(pi / 2, 0.0)))
    projector.show(0)
    np.testing.assert_array_equal(peer.shown(), picture(0, replace(SEQUENCE, orientations_rad=(pi / 2, 0.0))))


@dataclass
class Looking:
    """A camera that pulses expose, which sees what the controller plays."""

    peer: Peer
    left: int = 0
    facts: CameraFacts = field(default=CameraFacts(COLUMNS, ROWS, "uint8", 255, 1.0, 0.0))
    _read: int = 0

    def arm(self, exposure: float) -> None:
        raise AssertionError

    def trigger(self) -> None:
        raise AssertionError

    def arm_burst(self, burst: Burst) -> None:
        self._read = 0

    def read(self, timeout_s: float) -> Frame:
        shown = self.peer.played()[self._read]
        self._read += 1
        return Frame(self._read, shown.time_s, shown.levels)

    def left_over(self, timeout_s: float) -> int:
        return self.left

    def disarm(self) -> None:
        pass


def test_a_burst_is_seen_as_it_was_loaded(peer: Peer) -> None:
    projector = opened(peer)
    projector.load(SEQUENCE)
    seen = played(Players(projector, {"C1": Looking(peer)}), BURST, 1.0, lambda number: None)
    assert len(seen) == SEQUENCE.frames
    for number, one in enumerate(seen):
        np.testing.assert_array_equal(one["C1"].image, picture(number))
    assert not peer.running


@pytest.mark.parametrize("status", [0x41, 0x81])
def test_a_sequencer_that_stops_is_told(peer: Peer, status: int) -> None:
    projector = opened(peer)
    projector.load(SEQUENCE)
    peer.status = status
    with pytest.raises(FrameLost, match=f"P1 stopped in the middle of its patterns.*{status:#x}"):
        played(Players(projector, {"C1": Looking(peer)}), BURST, 1.0, lambda number: None)
    assert not peer.running


def test_an_answer_to_something_else_is_not_taken(peer: Peer) -> None:
    projector = opened(peer)
    projector.load(SEQUENCE)
    projector.play(BURST)
    peer.stale = True
    projector.wait()  # the stale status would be one of a sequencer that stopped


def test_what_goes_wrong_is_named(peer: Peer) -> None:
    peer.refuses = codec.Command.PATTERN
    with pytest.raises(DeviceFault, match=r"P1 refuses PATTERN \(0x1a34\)"):
        opened(peer).load(SEQUENCE)
    peer.refuses, peer.silent = 0, True
    with pytest.raises(LinkLost, match="P1 did not answer HARDWARE_STATUS within 2 s"):
        opened(peer)
    peer.silent, peer.status = False, 0x03
    with pytest.raises(DeviceFault, match=r"P1 did not start up \(hardware status 0x03\)"):
        opened(peer)
    peer.status, peer.mode_after = 0x01, 10
    projector = opened(peer)  # it needs half a second for another mode
    peer.mode_after = 1000
    with pytest.raises(DeviceFault, match="P1 does not take images by USB"):
        projector.connect()


def test_a_load_that_broke_off_is_not_taken_for_done(peer: Peer) -> None:
    projector = opened(peer)
    projector.load(SEQUENCE)
    other = replace(SEQUENCE, densities=(6, 5))
    peer.refuses, peer.passes = codec.Command.IMAGE, 7  # some fringes are others by then
    with pytest.raises(DeviceFault):
        projector.load(other)
    peer.refuses = 0
    projector.load(SEQUENCE)
    for number in range(SEQUENCE.frames):
        projector.show(number)
        np.testing.assert_array_equal(peer.shown(), picture(number))


def test_what_it_cannot_do_is_said(peer: Peer) -> None:
    projector = opened(peer)
    with pytest.raises(InvalidInput, match="room for 53 patterns, and the sequence has 54"):
        projector.load(FringeSequence((9, 8, 7), 9))
    with pytest.raises(InvalidInput, match="P1 is not given dimmed patterns"):
        projector.load(SEQUENCE, np.ones((ROWS, COLUMNS), np.float32))
    for wrong in ({"pattern_ms": 0.0}, {"settle_ms": -1.0}):
        with pytest.raises(InvalidInput, match="projector P1 shows patterns for"):
            replace(SETTINGS, **wrong)  # type: ignore[arg-type]


RIG = """
name = "hall"
[[cameras]]
name = "C1"
driver = "aravis"
device = "192.168.1.20"
columns = 160
rows = 120
pixel_format = "Mono8"
exposure_ms = 20.0
noise_gain = 0.2
read_noise = 1.5
pulse_line = "Line2"
[[projectors]]
name = "P1"
driver = "dlpc900"
device = "DEVICE"
columns = 1920
rows = 1080
pulses = { cameras = ["C1"], period_ms = 20.0 }
"""


def test_a_rig_file_names_its_file(tmp_path: Path) -> None:
    rig = parse_rig(RIG, "rig.toml", known_sensors())
    assert rig.way("P1", ("C1",), (1.0, 4.0)) == "patterns played in a burst, one every 20, 80 ms"
    (settings,) = rig.projectors
    assert isinstance(settings, Dlpc900Settings)
    assert settings.pulses == PulseTrain(("C1",), 20.0)
    with pytest.raises(InvalidInput, match="C1 for 0 ms: give all of these one exposure_ms"):
        parse_rig(RIG.replace("exposure_ms = 20.0", ""), "rig.toml", known_sensors())
    lost = replace(settings, device=str(tmp_path / "nowhere"))
    with ExitStack() as ending, pytest.raises(LinkLost, match="nowhere of 'P1' cannot be opened"):
        connect(lost, DriverContext(SimulatedClock(), ending))


def test_reports_go_through_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "hid")
    device = HidDevice("P1", str(tmp_path / "hid"))
    device.write(bytes(range(1, 65)))
    assert device.read(1.0) == bytes(range(64))  # its number comes before a report, which is zero
    device.flush()
    assert device.read(0.0) == b""
    device.close()
    device.close()
    with pytest.raises(LinkLost, match="hid of 'P1' broke"):
        device.write(b"")
