"""One request at a time: whose reply is whose, whatever else is on the line."""

from __future__ import annotations

import struct
from collections.abc import Callable
from math import radians

import pytest

from sms_jobs.errors import LinkLost
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.codecs import powercube as m5
from sms_jobs.instruments.codecs import schunk_motion as motion
from sms_jobs.instruments.codecs.lines import LineDecoder
from sms_jobs.instruments.drivers.line_device import LineDevice
from sms_jobs.instruments.drivers.powercube import PowerCubes
from sms_jobs.instruments.drivers.ptu46 import Ptu46
from sms_jobs.instruments.drivers.schunk_motion import SchunkMotion
from sms_jobs.instruments.simulated.serial.line import SimulatedLine
from sms_jobs.instruments.transports.memory import MemoryWire
from sms_jobs.records.serial_links import Fault, LineProtocol, SerialLink

LINK = SerialLink("simulated", 38400, reply_timeout_s=0.1, retries=2)
PROTOCOL = LineProtocol(accepted="^R", refused="^N")


class Scripted:
    """A device that answers each request with bytes of the test's choice, and may speak unasked."""

    def __init__(
        self, answer: Callable[[bytes], list[bytes]], unasked: tuple[tuple[float, bytes], ...] = ()
    ) -> None:
        self.requests: list[bytes] = []
        self._answer = answer
        self._unasked = list(unasked)

    def receive(self, data: bytes, now: float) -> list[bytes]:
        self.requests.append(data)
        return self._answer(data)

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        told = [(at, data) for at, data in self._unasked if at <= now]
        self._unasked = [(at, data) for at, data in self._unasked if at > now]
        return told

    def next_event(self) -> float | None:
        return min((at for at, _ in self._unasked), default=None)

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        return reply


def wire(device: Scripted, *faults: Fault) -> tuple[MemoryWire, SimulatedClock]:
    clock = SimulatedClock()
    return MemoryWire(SimulatedLine(device, LINK.baud_rate, faults), clock), clock


def echoing(data: bytes) -> list[bytes]:
    return [b"R" + data]


def test_a_late_reply_never_answers_another_question() -> None:
    # Without an address in the replies only silence tells them apart. A reply may be late by the time limit,
    # the silence before the next attempt and the silence after it: 0.1 s each.
    for milliseconds in range(90, 300):
        device = Scripted(echoing)
        transport, clock = wire(device, Fault("late-reply", amount=milliseconds / 1000.0))
        line = LineDevice("box", transport, clock, LINK, PROTOCOL)
        for text in ("A", "B", "C"):
            assert line.request(text) == f"R{text}", f"late by {milliseconds} ms"


def test_half_a_line_that_was_heard_before_is_forgotten() -> None:
    device = Scripted(echoing, unasked=((0.5, b"N7"),))  # and no end of line
    transport, clock = wire(device)
    line = LineDevice("box", transport, clock, LINK, PROTOCOL)
    clock.sleep(1.0)
    assert line.request("A") == "RA"
    assert len(device.requests) == 1


def test_a_whole_line_that_was_heard_before_answers_nothing() -> None:
    device = Scripted(echoing, unasked=((0.5, b"Rold\r\n"),))
    transport, clock = wire(device)
    line = LineDevice("box", transport, clock, LINK, PROTOCOL)
    clock.sleep(1.0)
    assert line.request("A") == "RA"


def position(module: int, parameter: int, value: float, command: int = m5.Command.GET) -> bytes:
    data = struct.pack("<BBf", command, parameter, value)
    return m5.encode(m5.Message(module, data, from_module=True))


@pytest.mark.parametrize(
    "stranger",
    [
        position(11, m5.Parameter.POSITION, 9.0),
        position(12, m5.Parameter.VELOCITY, 9.0),
        position(12, m5.Parameter.POSITION, 9.0, command=m5.Command.SET),
        m5.encode(m5.Message(12, m5.get(m5.Parameter.POSITION))),  # an echo of the question
    ],
    ids=["another-module", "another-parameter", "another-command", "echo"],
)
def test_a_powercube_reply_belongs_to_its_question(stranger: bytes) -> None:
    device = Scripted(lambda _data: [stranger, position(12, m5.Parameter.POSITION, 0.5)])
    transport, clock = wire(device)
    assert PowerCubes("stage", transport, clock, LINK).position(12) == 0.5
    assert len(device.requests) == 1
    # The stranger alone is no answer.
    transport, clock = wire(Scripted(lambda _data: [stranger]))
    with pytest.raises(LinkLost, match="none of them an answer"):
        PowerCubes("stage", transport, clock, LINK).position(12)


def state(module: int, value: float) -> bytes:
    data = struct.pack("<3fBB", value, 0.0, 0.0, motion.Status.REFERENCED, 0)
    return motion.encode(motion.Frame(motion.Group.FROM_MODULE, module, motion.Command.GET_STATE, data))


@pytest.mark.parametrize(
    "stranger",
    [
        state(11, 9.0),
        motion.encode(motion.Frame(motion.Group.FROM_MODULE, 12, motion.Command.STOP, b"OK")),
        motion.encode(motion.get_state(12)),
        motion.encode(motion.Frame(motion.Group.FROM_MODULE, 12, motion.Command.REACHED, bytes(4))),
    ],
    ids=["another-module", "another-command", "echo", "unasked"],
)
def test_a_motion_reply_belongs_to_its_question(stranger: bytes) -> None:
    device = Scripted(lambda _data: [stranger, state(12, 30.0)])
    transport, clock = wire(device)
    assert SchunkMotion("stage", transport, clock, LINK).state(12).position == 30.0
    assert len(device.requests) == 1
    transport, clock = wire(Scripted(lambda _data: [stranger]))
    with pytest.raises(LinkLost, match="none of them an answer"):
        SchunkMotion("stage", transport, clock, LINK).state(12)


def test_an_answer_without_its_number_is_asked_for_again() -> None:
    replies = iter([b"* \n", b"*\n", b"* -7\n"])
    transport, clock = wire(Scripted(lambda _data: [next(replies)]))
    assert Ptu46("stage", transport, clock, LINK).ask("pp") == -7.0


def test_a_device_that_never_falls_silent_does_not_hold_up_for_ever() -> None:
    chatter = tuple((0.02 * k, b"x\r\n") for k in range(1000))
    device = Scripted(lambda _data: [], unasked=chatter)
    transport, clock = wire(device)
    with pytest.raises(LinkLost, match="none of them an answer"):
        LineDevice("box", transport, clock, LINK, PROTOCOL).request("A")
    assert len(device.requests) == 3
    # Three attempts of 0.1 s, and twenty pieces of chatter in each silence that does not come.
    assert clock.monotonic() < 3 * (0.1 + 20 * 0.1)


def test_a_frame_in_pieces_is_one_frame() -> None:
    decoder, line = LineDecoder("\r\n"), b"R12.5\r\n"
    assert [frame for byte in line for frame in decoder.feed(bytes((byte,)))] == ["R12.5"]
    frames = motion.SchunkMotionDecoder()
    assert len([f for byte in state(3, radians(1.0)) for f in frames.feed(bytes((byte,)))]) == 1
