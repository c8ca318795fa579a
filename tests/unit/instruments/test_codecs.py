"""Protocols: published frames byte for byte, round trips, and streams with noise in any pieces."""

from __future__ import annotations

import random
import struct
import time
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sms_jobs.instruments.codecs import powercube as m5
from sms_jobs.instruments.codecs import ptu46
from sms_jobs.instruments.codecs import schunk_motion as motion
from sms_jobs.instruments.codecs.decoder import Decoder
from sms_jobs.instruments.codecs.lines import (
    LineDecoder,
    encode_line,
    encode_reply,
    interpret,
    sum_hex,
    xor_hex,
)
from sms_jobs.records.serial_links import LineProtocol

LIGHT_CONTROLLER = LineProtocol(
    prefix="@",
    terminator="\r\n",
    reply_terminator="\r\n",
    checksum="sum",
    accepted=r"^O",
    refused=r"^N(?P<error>.*)",
)
TWO_LETTERS = LineProtocol(
    terminator=">", reply_terminator=">", accepted=r"^[A-Z]{2}", refused=r"^ERR(?P<error>.*)"
)
PROMPTED = LineProtocol(
    terminator="\r", reply_terminator=">", accepted=r"OK$", refused=r"Error (?P<error>\d+: .*)"
)


STEP_IN_1500_MS = struct.pack("<BBfH", m5.Command.MOVE, m5.Move.STEP_EXTENDED, -1.0, 1500)
"""A move that no stage makes; of its published frame a byte of the data is stuffed."""


@pytest.mark.parametrize(
    ("module", "data", "frame"),
    [
        (12, m5.get(m5.Parameter.POSITION), "02 05 82 0a 3c cd 03"),
        (8, m5.get(m5.Parameter.POSITION), "02 05 10 82 0a 3c 4d 03"),
        (11, m5.move(m5.Move.RAMP, 0.5), "02 05 66 0b 04 00 00 00 3f b9 03"),
        (12, STEP_IN_1500_MS, "02 05 88 0b 10 90 00 00 80 bf dc 05 ca 03"),
        (12, bytes((m5.Command.HALT,)), "02 05 81 10 82 88 03"),
        (11, bytes((m5.Command.HOME,)), "02 05 61 01 67 03"),
    ],
    ids=["position", "stuffed-header", "ramp", "step", "stuffed-data", "home"],
)
def test_powercube_frames_as_published(module: int, data: bytes, frame: str) -> None:
    assert m5.encode(m5.Message(module, data)).hex(" ") == frame
    assert m5.PowerCubeDecoder().feed(bytes.fromhex(frame)) == [m5.Message(module, data)]


@pytest.mark.parametrize(
    ("frame", "data"),
    [
        (motion.request(1, motion.Command.MOVE_POSITION, 10.0), "05 01 05 b0 00 00 20 41 48 80"),
        # The maker's manual gives these as examples.
        (motion.request(1, motion.Command.REFERENCE), "05 01 01 92 d1 31"),
        (motion.request(1, motion.Command.ACKNOWLEDGE), "05 01 01 8b 10 fb"),
        (
            motion.Frame(motion.Group.FROM_MODULE, 1, motion.Command.REFERENCE, b"OK"),
            "07 01 03 92 4f 4b e9 d9",
        ),
        (
            motion.Frame(motion.Group.FROM_MODULE, 1, motion.Command.ACKNOWLEDGE, b"OK"),
            "07 01 03 8b 4f 4b 38 1e",
        ),
    ],
    ids=["move", "reference", "acknowledge", "referenced", "acknowledged"],
)
def test_motion_frames_as_published(frame: motion.Frame, data: str) -> None:
    assert motion.encode(frame).hex(" ") == data
    assert motion.SchunkMotionDecoder().feed(bytes.fromhex(data)) == [frame]


def test_the_check_value_of_crc_16_arc() -> None:
    assert motion.crc16(b"123456789") == 0xBB3D  # of the catalogue of CRC algorithms


def test_a_state_as_a_module_sent_it() -> None:
    data = bytes.fromhex("d6 a3 70 41 56 c9 41 40 3c 41 eb 3e 03 00")
    state = motion.module_state(motion.Frame(motion.Group.FROM_MODULE, 1, motion.Command.GET_STATE, data))
    assert state is not None
    assert state.position == pytest.approx(15.04, abs=1e-5)  # float32 of a number near 15
    assert state.status == motion.Status.REFERENCED | motion.Status.MOVING


@given(st.integers(0, 31), st.binary(max_size=8), st.sampled_from(["maker", "carmen"]), st.booleans())
def test_powercube_round_trip_in_both_dialects(
    module: int, data: bytes, checksum: m5.Checksum, from_module: bool
) -> None:
    message = m5.Message(module, data, from_module)
    frame = m5.encode(message, checksum)
    assert not {0x02, 0x03} & set(frame[1:-1])
    assert m5.PowerCubeDecoder().feed(frame) == [message]


@given(st.sampled_from(list(motion.Group)), st.integers(1, 255), st.integers(0, 255), st.binary(max_size=63))
def test_motion_round_trip(group: motion.Group, module: int, command: int, data: bytes) -> None:
    frame = motion.Frame(group, module, command, data)
    assert motion.SchunkMotionDecoder().feed(motion.encode(frame)) == [frame]


def test_a_wrong_checksum_is_no_message() -> None:
    frame = bytearray.fromhex("02 05 82 0a 3c cd 03")
    frame[-2] ^= 0x40
    decoder = m5.PowerCubeDecoder()
    assert decoder.feed(bytes(frame)) == []
    assert decoder.refused == 1


@pytest.mark.parametrize(
    ("protocol", "request_text", "frame"),
    [
        # 40+30+31+46+31+32+38 = 182, hexadecimal.
        (LIGHT_CONTROLLER, "01F128", b"@01F12882\r\n"),
        (TWO_LETTERS, "TR3", b"TR3>"),
        (PROMPTED, "out 2", b"out 2\r"),
    ],
    ids=["checksum", "two-letters", "prompt"],
)
def test_lines_as_configured(protocol: LineProtocol, request_text: str, frame: bytes) -> None:
    assert encode_line(protocol, request_text) == frame
    assert LineDecoder.of_requests(protocol).feed(frame) == [protocol.prefix + request_text]


@pytest.mark.parametrize(
    ("protocol", "reply", "error"),
    [
        (LIGHT_CONTROLLER, "O", None),
        (LIGHT_CONTROLLER, "N02", "02"),
        (TWO_LETTERS, "TR3", None),
        (TWO_LETTERS, "ERR 4", "4"),
        (PROMPTED, "OK", None),
        (PROMPTED, "Error 3: no such output", "3: no such output"),
    ],
)
def test_replies_are_told_apart(protocol: LineProtocol, reply: str, error: str | None) -> None:
    [line] = LineDecoder.of_replies(protocol).feed(encode_reply(protocol, reply))
    answer = interpret(protocol, line)
    assert answer is not None
    assert answer.error == error


def test_checksums_of_lines() -> None:
    assert sum_hex(b"\xff\x02") == b"01"
    assert xor_hex(b"\x0f\xf0") == b"FF"


def test_pan_tilt_units_speak_in_counts() -> None:
    assert ptu46.command("pp", -100) == b"pp-100 "
    assert ptu46.command("tr") == b"tr "
    accepted = ptu46.reply("* 185.1428")
    assert accepted == ptu46.Reply(accepted=True, text="185.1428", value=185.1428)
    refused = ptu46.reply("! Maximum allowable Pan position is 3090")
    assert refused is not None
    assert not refused.accepted
    assert ptu46.reply("\x00garbage") is None
    # The published resolution of the unit is 0.0514 degrees.
    assert ptu46.radians_per_count(185.1428) == pytest.approx(0.0514 * 3.14159265 / 180.0, rel=1e-3)


GOOD = {
    "powercube": bytes.fromhex("02 05 10 82 0a 3c 4d 03"),
    "motion": bytes.fromhex("07 01 03 92 4f 4b e9 d9"),
    "line": b"OK\r\n",
}
DECODERS: dict[str, Callable[[], Decoder[object]]] = {
    "powercube": m5.PowerCubeDecoder,
    "motion": motion.SchunkMotionDecoder,
    "line": lambda: LineDecoder("\r\n"),
}
# What ends any beginning of a frame that noise may have made: the end of a frame, or as many bytes as the
# longest frame may have.
ENDS = {"powercube": b"\x03", "motion": bytes(70), "line": b"\r\n"}


@pytest.mark.parametrize("protocol", list(GOOD))
@given(noise=st.lists(st.binary(max_size=60), max_size=8))
@settings(max_examples=150)
def test_any_noise_in_any_pieces(protocol: str, noise: list[bytes]) -> None:
    # The same bytes give the same frames, however they are cut; and after noise a good frame is found.
    decoder, whole = DECODERS[protocol](), DECODERS[protocol]()
    in_pieces = [frame for piece in noise for frame in decoder.feed(piece)]
    assert in_pieces == whole.feed(b"".join(noise))
    for one in (decoder, whole):
        one.feed(ENDS[protocol])
        assert len(one.feed(GOOD[protocol])) == 1


@pytest.mark.parametrize("protocol", list(GOOD))
def test_a_frame_is_found_behind_the_beginning_of_another(protocol: str) -> None:
    good = GOOD[protocol]
    for cut in range(1, len(good)):
        decoder = DECODERS[protocol]()
        if protocol == "line":  # a line has no beginning: the half is part of the next
            decoder.feed(good[:cut])
            decoder.reset()
        else:
            decoder.feed(good[:cut])
        assert len(decoder.feed(good)) == 1, f"after {cut} bytes"


@pytest.mark.parametrize("protocol", list(GOOD))
def test_noise_does_not_pile_up(protocol: str) -> None:
    decoder = DECODERS[protocol]()
    for _ in range(50):
        decoder.feed(bytes([0x05, 0x07, 0x40, 0x41]) * 100)
    kept: Sequence[int] = getattr(decoder, "_bytes", None) or getattr(decoder, "_body", None) or b""
    assert len(kept) <= 4096


@pytest.mark.long
@pytest.mark.parametrize("protocol", list(GOOD))
def test_random_bytes_for_long(protocol: str, record_property: Callable[[str, object], None]) -> None:
    generator = random.Random(7)
    decoder, end, good = DECODERS[protocol](), ENDS[protocol], GOOD[protocol]
    total, found, began = 0, 0, time.process_time()
    # Bytes that mean something to a protocol come more often than by chance, or noise would test little.
    favourites = b"\x02\x03\x10\x05\x07\x01\x04\r\n>*O"
    while total < 16_000_000:
        noise = bytearray(generator.randbytes(generator.randrange(1, 4000)))
        for _ in range(len(noise) // 3):
            noise[generator.randrange(len(noise))] = generator.choice(favourites)
        decoder.feed(bytes(noise))
        decoder.feed(end)
        assert decoder.feed(good), "a good frame after noise was not found"
        total += len(noise)
        found += 1
    seconds = time.process_time() - began
    print(f"{protocol}: {total} random bytes, {found} good frames found, {seconds:.1f} s of CPU")
    record_property("bytes", total)
