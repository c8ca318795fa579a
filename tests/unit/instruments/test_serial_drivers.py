"""Drivers and simulators against exchanges written by hand, and what states mean."""

from __future__ import annotations

from math import radians

import pytest

from sms_jobs.errors import DeviceFault, LimitExceeded, LinkLost
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.codecs.powercube import State
from sms_jobs.instruments.codecs.schunk_motion import Command
from sms_jobs.instruments.drivers.powercube import PowerCubes, explain
from sms_jobs.instruments.drivers.ptu46 import Ptu46, PtuAxes
from sms_jobs.instruments.drivers.schunk_motion import SchunkMotion
from sms_jobs.instruments.simulated.serial.axis import SimulatedAxis
from sms_jobs.instruments.simulated.serial.line import SimulatedLine
from sms_jobs.instruments.simulated.serial.powercube import SimulatedPowerCubes
from sms_jobs.instruments.simulated.serial.ptu46 import COUNT_RAD, SimulatedPtu46
from sms_jobs.instruments.simulated.serial.schunk_motion import SimulatedMotionModules
from sms_jobs.instruments.transports.memory import MemoryWire
from sms_jobs.instruments.transports.serial_port import SerialPort
from sms_jobs.records.instruments import Stage
from sms_jobs.records.serial_links import Fault, SerialLink

LINK = SerialLink("simulated", 38400, reply_timeout_s=0.06, retries=2)


def axes(*faults: Fault) -> dict[int, SimulatedAxis]:
    return {
        address: SimulatedAxis(-2.0, 2.0, 1.0, 2.0, faults=[f for f in faults if f.axis == name])
        for address, name in ((11, "pan"), (12, "tilt"))
    }


def cubes(*faults: Fault) -> tuple[PowerCubes, SimulatedClock]:
    clock = SimulatedClock()
    line = SimulatedLine(SimulatedPowerCubes(axes(*faults)), LINK.baud_rate, faults)
    return PowerCubes("stage", MemoryWire(line, clock), clock, LINK), clock


def wait(modules: PowerCubes, clock: SimulatedClock) -> None:
    """Wait until both modules stand; the pause is that of the stage."""
    while any(State.MOTION in modules.state(module) for module in (11, 12)):
        clock.sleep(0.05)


def home(modules: PowerCubes, clock: SimulatedClock) -> None:
    for module in (11, 12):
        modules.home(module)
    wait(modules, clock)
    assert all(State.HOME_OK in modules.state(module) for module in (11, 12))


def test_a_simulated_module_answers_as_a_real_one() -> None:
    device = SimulatedPowerCubes(axes())
    # Home of module 11: a plain acknowledgement repeats the command and says 64 (hexadecimal), with the reply
    # bit in the header: 08 + 1, 62 for two bytes, and 09 + 62 + 01 + 64 = d0.
    assert [r.hex(" ") for r in device.receive(bytes.fromhex("02 05 61 01 67 03"), 0.0)] == [
        "02 09 62 01 64 d0 03"
    ]
    # Position of module 12, 0 rad at power-on is 0.2 rad rounded to the encoder's 1/672 degree.
    [reply] = device.receive(bytes.fromhex("02 05 82 0a 3c cd 03"), 0.0)
    assert reply[:4].hex(" ") == "02 09 86 0a"
    # Halt all, nobody answers.
    assert device.receive(bytes.fromhex("02 04 01 10 82 07 03"), 0.0) == []


def test_modules_say_what_they_are() -> None:
    modules, _ = cubes()
    assert str(modules.facts(11)) == "PowerCube 11: serial number 21011, firmware 2512"
    with pytest.raises(LinkLost):
        modules.facts(13)


def test_homing_moving_and_waiting() -> None:
    modules, clock = cubes()
    with pytest.raises(DeviceFault, match="it was not homed: home it first"):
        modules.move_ramp(11, 0.5)
    home(modules, clock)
    for module in (11, 12):
        modules.set_profile(module, 0.5, 1.0)
    began = clock.monotonic()
    modules.move_ramp(11, 1.0)
    modules.move_ramp(12, -0.5)
    assert State.MOTION in modules.state(11)
    wait(modules, clock)
    # A distance d at velocity v and acceleration a takes d / v + v / a = 2.5 s; polling adds 0.05 s.
    assert clock.monotonic() - began == pytest.approx(2.5, abs=0.2)
    assert modules.position(11) == pytest.approx(1.0, abs=radians(0.04))
    assert modules.position(12) == pytest.approx(-0.5, abs=radians(0.04))


def test_modules_wait_for_the_common_start() -> None:
    modules, clock = cubes()
    home(modules, clock)
    for module in (11, 12):
        modules.synchronise(module, wait_for_start=True)
        modules.move_ramp(module, 0.5)
    clock.sleep(1.0)
    assert not any(State.MOTION in modules.state(module) for module in (11, 12))
    modules.start_all()
    assert all(State.MOTION in modules.state(module) for module in (11, 12))


def test_limits_are_set_and_kept() -> None:
    modules, clock = cubes()
    home(modules, clock)
    modules.set_limits(11, -0.5, 0.75)
    for beyond in ("0.7501", "-0.5001"):
        with pytest.raises(
            LimitExceeded, match=f"module 11 .* {beyond} rad: it stands beyond its soft limit"
        ):
            modules.move_ramp(11, float(beyond))
        modules.reset(11)
    modules.move_ramp(11, 0.75)  # exact in float32


def test_an_error_has_a_sentence_and_a_reset_clears_it() -> None:
    modules, clock = cubes(Fault("tow-error", at=1))
    home(modules, clock)
    modules.move_ramp(11, 1.0)
    modules.move_ramp(12, 1.5)
    while not explain(modules.state(11)):
        clock.sleep(0.05)
    assert "its tow limit was exceeded" in explain(modules.state(11))
    assert State.MOTION in modules.state(12)
    modules.halt_all()
    assert State.HALTED in modules.state(12)
    modules.reset(11)
    assert not explain(modules.state(11))
    modules.move_ramp(11, 1.0)
    wait(modules, clock)
    assert modules.position(11) == pytest.approx(1.0, abs=radians(0.04))


def test_every_error_bit_has_a_sentence() -> None:
    harmless = (
        State.HOME_OK | State.REFERENCE_SWITCH | State.LIMIT_SWITCH_1 | State.LIMIT_SWITCH_2 | State.BRAKE
        | State.CURRENT_LIMIT | State.MOTION | State.RAMP_ACCELERATE | State.RAMP_STEADY
        | State.RAMP_DECELERATE | State.RAMP_END | State.STEP_IN_PROGRESS | State.BUFFER_FULL
    )  # fmt: skip
    assert explain(harmless) == ""
    for bit in State:
        assert bool(explain(bit)) == (bit not in harmless)
    assert explain(State.ERROR | State.HALTED | State.TOW_ERROR) == explain(State.TOW_ERROR)


def test_a_reply_that_comes_too_late_does_not_answer_the_next_question() -> None:
    # The first reply comes 0.08 s late, when the question has been asked again: both answer alike. Then
    # another question is asked, while the second answer to the first is still under way.
    modules, _ = cubes(Fault("late-reply", at=1, amount=0.08))
    assert modules.position(11) == pytest.approx(0.2, abs=1e-3)
    assert State.HOME_OK not in modules.state(11)
    assert modules.facts(12).serial_number == 21012


def test_who_does_not_answer_is_named_with_what_was_heard() -> None:
    modules, _ = cubes()
    with pytest.raises(
        LinkLost, match=r"'stage' on simulated .* 3 times .* position \(module 5\); nothing came"
    ):
        modules.position(5)
    modules, _ = cubes(Fault("wrong-checksum", times=0))
    with pytest.raises(LinkLost, match=r"bytes came, none of them an answer: check the baud rate \(38400\)"):
        modules.position(11)


def motion(*faults: Fault) -> tuple[SchunkMotion, SimulatedClock]:
    clock = SimulatedClock()
    device = SimulatedMotionModules(axes(*faults), radians(1.0))
    line = SimulatedLine(device, LINK.baud_rate, faults)
    return SchunkMotion("stage", MemoryWire(line, clock), clock, LINK), clock


def test_modules_tell_unasked_that_they_have_arrived() -> None:
    modules, clock = motion()
    with pytest.raises(DeviceFault, match=r"refuses a move to 30 .* error 05"):
        modules.move(11, 30.0)
    modules.reference(11)
    clock.sleep(5.0)
    modules.events()
    seconds = modules.move(11, 30.0)
    # 30 degrees at 1 rad/s and 2 rad/s^2.
    assert seconds == pytest.approx(radians(30.0) + 0.5, abs=1e-3)
    clock.sleep(seconds + 0.1)
    [event] = modules.events()
    assert event.command == Command.REACHED
    assert event.module == 11
    assert event.value == pytest.approx(30.0, abs=0.04)
    assert modules.state(11).position == pytest.approx(30.0, abs=0.04)


def test_what_is_said_while_something_is_asked_is_not_lost() -> None:
    modules, clock = motion()
    modules.reference(11)
    clock.sleep(5.0)
    seconds = modules.move(11, 10.0)
    clock.sleep(seconds - 0.001)
    modules.state(12)  # module 11 arrives in the middle of the answer of module 12
    modules.state(12)
    assert [event.command for event in modules.events()] == [Command.REACHED]


def test_a_module_that_is_blocked_tells_and_wants_to_be_acknowledged() -> None:
    modules, clock = motion(Fault("tow-error", at=1))
    modules.reference(11)
    clock.sleep(5.0)
    modules.move(11, 40.0)
    clock.sleep(5.0)
    assert [event.command for event in modules.events()] == [Command.BLOCKED]
    assert modules.state(11).error
    with pytest.raises(DeviceFault, match="acknowledge it"):
        modules.move(11, 40.0)
    modules.acknowledge(11)
    modules.move(11, 40.0)


def test_a_frame_of_another_module_answers_nothing() -> None:
    device = SimulatedMotionModules(axes(), radians(1.0))
    [reply] = device.receive(bytes.fromhex("05 0b 06 95 00 00 00 00 07") + b"\x00\x00", 0.0) or [b""]
    assert reply == b""  # the checksum was wrong: a module is silent


def test_a_digit_that_is_lost_from_a_constant_is_noticed() -> None:
    # The reply to the resolution, "* 185.1428", loses its point, or a digit; once, or in a burst.
    for at, times in ((4, 1), (4, 5), (5, 2), (9, 3)):
        clock = SimulatedClock()
        axes_ = {name: SimulatedAxis(-1.0, 1.0, 0.5, 1.0) for name in ("pan", "tilt")}
        fault = Fault("dropped-byte", at=at, times=times)
        line = SimulatedLine(SimulatedPtu46(axes_), LINK.baud_rate, [fault])
        stage = Stage("stage", LINK, "ptu46")
        unit = PtuAxes(stage, Ptu46("stage", MemoryWire(line, clock), clock, LINK))
        unit.open()
        assert unit.resolution_rad("pan") == pytest.approx(COUNT_RAD)
        assert unit.state("pan").position_rad == pytest.approx(0.2, abs=COUNT_RAD)


def test_a_resolution_that_cannot_be_is_refused() -> None:
    clock = SimulatedClock()
    device = SimulatedPtu46({name: SimulatedAxis(-1.0, 1.0, 0.5, 1.0) for name in ("pan", "tilt")})
    # The resolution loses its point in both rounds of five questions.
    faults = [Fault("dropped-byte", at=4), Fault("dropped-byte", at=9)]
    line = SimulatedLine(device, LINK.baud_rate, faults)
    unit = PtuAxes(Stage("stage", LINK, "ptu46"), Ptu46("stage", MemoryWire(line, clock), clock, LINK))
    with pytest.raises(DeviceFault, match=r"resolution of 1\.85143e\+06 seconds of arc on its pan axis"):
        unit.open()


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(
        LinkLost, match=r"port /nowhere/tty of 'stage' cannot be opened \(.*\): check that the cable"
    ):
        SerialPort("stage", SerialLink("/nowhere/tty"))
