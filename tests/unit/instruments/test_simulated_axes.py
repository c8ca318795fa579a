"""Simulated axes and wires: kinematics as equations of motion, times as baud rates."""

from __future__ import annotations

from itertools import pairwise
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.instruments.simulated.serial.axis import Ramp, SimulatedAxis
from sms_jobs.instruments.simulated.serial.line import SimulatedLine
from sms_jobs.records.serial_links import Fault

angles = st.floats(-pi, pi)


@given(angles, angles, st.floats(0.1, 5.0), st.floats(0.1, 50.0))
def test_a_ramp_obeys_its_velocity_and_acceleration(
    start: float, end: float, velocity: float, acceleration: float
) -> None:
    ramp = Ramp(10.0, start, end, velocity, acceleration)
    assert ramp.position(9.0) == start
    assert ramp.position(ramp.ends + 1.0) == end
    step = max((ramp.ends - ramp.begins) / 400.0, 1e-6)
    times = [ramp.begins + (k - 1) * step for k in range(403)]
    positions = [ramp.position(t) for t in times]
    velocities = [(b - a) / step for a, b in pairwise(positions)]
    accelerations = [(b - a) / step for a, b in pairwise(velocities)]
    # Differences of differences of numbers near pi: their rounding (4e-16) over the step squared.
    slack = 1e-6 + 8e-16 / step**2
    assert max(map(abs, velocities)) <= velocity * (1.0 + 1e-9) + 1e-15 / step
    assert max(map(abs, accelerations)) <= acceleration * (1.0 + 1e-6) + slack
    # It goes straight there: never back, never beyond.
    assert all(min(start, end) - 1e-12 <= p <= max(start, end) + 1e-12 for p in positions)


def test_an_axis_homes_moves_and_comes_in_slowly() -> None:
    axis = SimulatedAxis(-1.0, 1.0, 2.0, 4.0)
    assert not axis.homed
    axis.home(0.0)
    axis.advance(axis.ends)
    assert axis.homed
    assert axis.move(0.5, 10.0)
    assert axis.moving(10.1)
    ends = axis.ends
    drifts = [abs(axis.true_position(ends + t) - 0.5) for t in (0.0, 0.1, 0.2, 1.0)]
    assert drifts == sorted(drifts, reverse=True)
    assert drifts[-1] < 1e-6  # e^-10 of 0.03 degrees
    assert not axis.move(1.2, 20.0)
    assert axis.beyond_soft_limit


class Echo:
    """A device that answers with what it hears."""

    def receive(self, data: bytes, now: float) -> list[bytes]:
        return [data]

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        return []

    def next_event(self) -> float | None:
        return None

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        return reply[:-1] + b"!"


def test_bytes_take_their_time() -> None:
    # 20 bytes at 9600 baud: 200 bits and 200 bits back, and 2 ms to think.
    line = SimulatedLine(Echo(), 9600)
    line.send(bytes(20), 0.0)
    whole = 2 * 200 / 9600 + 0.002
    assert line.next_arrival() == pytest.approx(whole)
    assert line.take(whole - 200 / 9600) == b""
    assert len(line.take(whole - 100 / 9600)) == 10
    assert len(line.take(whole + 1e-6)) == 10
    assert line.next_arrival() is None


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (Fault("dropped-byte"), b"abd"),
        (Fault("garbled-byte"), bytes((0x61, 0x62, 0x63 ^ 0x80, 0x64))),
        (Fault("wrong-checksum"), b"abc!"),
        (Fault("unplugged"), b""),
        (Fault("dropped-byte", at=2), b"abcd"),
        (Fault("late-reply", amount=5.0), b""),
    ],
    ids=["dropped", "garbled", "checksum", "unplugged", "later", "late"],
)
def test_faults_befall_the_reply_that_they_name(fault: Fault, expected: bytes) -> None:
    line = SimulatedLine(Echo(), 9600, [fault])
    line.send(b"abcd", 0.0)
    assert line.take(1.0) == expected
    line.send(b"abcd", 2.0)
    if fault.at == 1 and fault.fault != "late-reply":
        assert line.take(3.0) == b"abcd"
    if fault.fault == "late-reply":
        assert line.take(10.0) == b"abcdabcd"


@given(st.integers(1, 5), st.integers(0, 3), st.integers(1, 12))
def test_a_fault_lasts_as_long_as_it_says(at: int, times: int, count: int) -> None:
    fault = Fault("garbled-byte", at=at, times=times)
    last = at + times - 1 if times else 10**9
    assert fault.befalls(count) == (at <= count <= last)
