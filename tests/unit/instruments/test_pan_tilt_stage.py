"""The pan-tilt stage: how it moves, what limits it, what it says when something is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import timedelta
from math import radians

import pytest

from sms_jobs.errors import DeviceFault, InvalidInput, LimitExceeded, WaitTimedOut
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.devices.connecting import Connector
from sms_jobs.instruments.devices.device import Status
from sms_jobs.instruments.devices.pan_tilt import PanTilt
from sms_jobs.instruments.drivers.axes import Axes, AxisName, AxisState
from sms_jobs.instruments.operation_log import OperationLog
from sms_jobs.instruments.simulated.serial.simulation import SerialSimulation
from sms_jobs.metrology.geometry.stage_poses import StagePose, uniform_poses
from sms_jobs.records.instruments import Axis, Instruments, Settling, Stage, TripodClearance
from sms_jobs.records.operations import Operation
from sms_jobs.records.serial_links import Fault, SerialLink

LINK = SerialLink("simulated", 38400, retries=2)
PAN = Axis(12, radians(-180.0), radians(180.0), velocity_rad_s=1.0, acceleration_rad_s2=2.0)
TILT = Axis(13, radians(-108.0), radians(108.0), velocity_rad_s=1.0, acceleration_rad_s2=2.0)
STAGE = Stage("stage", LINK, pan=PAN, tilt=TILT)


class Watched:
    """Axes that remember what they were told, and how far the pan axis has turned."""

    def __init__(self, axes: Axes) -> None:
        self._axes = axes
        self.moves: list[dict[AxisName, float]] = []

    def move(self, targets_rad: Mapping[AxisName, float]) -> None:
        self.moves.append(dict(targets_rad))
        self._axes.move(targets_rad)

    def open(self) -> tuple[str, ...]:
        return self._axes.open()

    def state(self, axis: AxisName) -> AxisState:
        return self._axes.state(axis)

    def resolution_rad(self, axis: AxisName) -> float:
        return self._axes.resolution_rad(axis)

    def home(self, axis: AxisName) -> None:
        self._axes.home(axis)

    def stop(self) -> None:
        self._axes.stop()

    def clear(self) -> None:
        self._axes.clear()

    def close(self) -> None:
        self._axes.close()


def bench(stage: Stage = STAGE) -> tuple[PanTilt, Watched, SimulatedClock, list[Operation]]:
    clock = SimulatedClock()
    simulation = SerialSimulation(Instruments(stages=(stage,)), clock)
    written: list[Operation] = []
    watched = Watched(Connector(clock, None, simulation).axes(stage))
    device = PanTilt(stage, watched, clock, OperationLog(clock, written.append))
    device.connect()
    device.stage()
    return device, watched, clock, written


def test_a_pose_is_any_number_of_turns_away_and_the_cable_does_not_coil() -> None:
    device, watched, _, _ = bench()
    for pan in (315.0, 337.5, 0.0, 22.5, 45.0):
        device.move(radians(pan), 0.0)
    assert [round(m["pan"] * 180.0 / 3.141592653589793, 6) for m in watched.moves] == [
        -45.0,
        -22.5,
        0.0,
        22.5,
        45.0,
    ]


def test_home_is_reached_the_way_the_stage_came() -> None:
    device, watched, _, _ = bench()
    for pan in (1.0, 2.0, 3.0):
        device.move(pan, 0.5)
    watched.moves.clear()
    device.home()
    # One move back over all of 3 rad, and not on by the remaining 3.28 rad of the turn.
    assert watched.moves == [{"pan": 0.0, "tilt": 0.0}]
    assert device.angles() == pytest.approx((0.0, 0.0), abs=radians(0.02))


@pytest.mark.parametrize(
    ("start", "groups", "seconds"),
    [
        # 1 rad and 0.5 rad at 1 rad/s with ramps of 0.5 s: 1.5 s and 1.0 s.
        ("together", 1, 1.5),
        ("on-signal", 1, 1.5),
        ("one-after-the-other", 2, 2.5),
    ],
)
def test_axes_move_together_or_one_after_the_other(start: str, groups: int, seconds: float) -> None:
    device, watched, clock, _ = bench(replace(STAGE, start=start))
    began = clock.monotonic()
    device.move(1.0, 0.5)
    assert len(watched.moves) == groups
    # Settling takes 0.3 s after the drift has come in, 0.11 s; questions over the line, up to 0.1 s a round.
    assert clock.monotonic() - began == pytest.approx(seconds + 0.4, abs=0.4)


def test_play_of_the_gears_is_always_on_one_side() -> None:
    device, watched, _, _ = bench(replace(STAGE, backlash_rad=0.05))
    device.move(0.5, 0.5)
    device.move(0.2, 0.8)
    # Upwards at once; downwards beyond the pose and back.
    assert watched.moves == [
        {"pan": 0.5, "tilt": 0.5},
        {"pan": pytest.approx(0.15), "tilt": 0.8},
        {"pan": 0.2, "tilt": 0.8},
    ]


def test_a_tilt_at_which_the_bar_meets_the_tripod_is_refused() -> None:
    clearance = TripodClearance(400.0, 19.0, 60.0, 0.0, 120.0, 50.0, radians(25.0))
    device, _, _, _ = bench(replace(STAGE, clearance=clearance))
    limit = device.ranges["tilt"].maximum_rad
    assert limit < TILT.maximum_rad
    device.move(0.0, 0.99 * limit)
    with pytest.raises(
        LimitExceeded, match=r"tilt axis of 'stage' .* where the bar would meet the tripod: it may go"
    ):
        device.move(0.0, 1.01 * limit)
    poses = uniform_poses(9, device.ranges["pan"], device.ranges["tilt"])
    assert max(p.tilt_rad for p in poses) <= limit
    assert any("tilt: " in fact for fact in device.describe().facts)


def test_a_unit_that_does_not_arrive_is_reported() -> None:
    device, _, clock, _ = bench(
        replace(STAGE, protocol="ptu46", faults=(Fault("tow-error", at=1, axis="tilt"),))
    )
    began = clock.monotonic()
    with pytest.raises(
        DeviceFault, match=r"'stage' is still \d\.\d+ rad from its pose when it should have arrived"
    ):
        device.move(0.0, 1.0)
    assert clock.monotonic() - began < 30.0
    device.recover()
    device.move(0.0, 1.0)
    assert device.angles()[1] == pytest.approx(1.0, abs=radians(0.06))


def test_a_servo_that_hunts_is_named_with_how_far_it_is_off() -> None:
    settling = Settling(radians(0.01), for_s=0.3, timeout_s=4.0, attempts=3)
    faults = (Fault("hunting-servo", at=2, times=0, amount=radians(0.2)),)
    device, watched, _, written = bench(replace(STAGE, settling=settling, faults=faults))
    device.move(0.1, 0.0)
    watched.moves.clear()
    with pytest.raises(
        DeviceFault, match=r"hunts: after 3 attempts of 4 s pan is off by up to 3\.\d\de-03 rad, more than"
    ):
        device.move(0.2, 0.0)
    assert len(watched.moves) == 3
    assert "hunts" in written[-1].outcome


def test_an_error_stands_until_it_is_cleared() -> None:
    device, _, _, _ = bench(replace(STAGE, faults=(Fault("soft-limit", at=1, axis="pan"),)))
    with pytest.raises(DeviceFault, match=r"pan axis of 'stage' stopped at .* soft limit"):
        device.move(1.0, 0.0)
    with pytest.raises(LimitExceeded, match="does not go to"):
        device.move(1.0, 0.0)
    device.recover()
    device.move(1.0, 0.0)


def test_every_operation_is_logged_as_it_ends() -> None:
    device, _, _, written = bench()
    device.move(0.3, 0.0)
    with pytest.raises(LimitExceeded):
        device.set(StagePose(0.0, 3.0))
    assert [o.operation for o in written] == ["connect", "reference", "move"]
    assert written[-1].detail == "pan 0.30000 rad, tilt 0.00000 rad"
    assert written[-1].seconds > 0.7  # 0.3 rad with ramps of 2 rad/s^2 take 2 sqrt(0.15) = 0.77 s
    assert written[-1].device == "stage"
    assert written[-1].outcome == "done"
    assert written[-1].time.utcoffset() == timedelta(0)


def test_a_move_shows_how_far_it_is() -> None:
    device, _, clock, _ = bench()
    status = device.set(StagePose(2.0, 0.0))
    told = []
    while not status.update():
        told.append(status.progress)
        clock.sleep(0.05)
    assert told == sorted(told)
    assert len(set(told)) > 10
    assert status.progress == 1.0
    assert status.error is None


def test_waiting_has_an_end() -> None:
    clock = SimulatedClock()

    def never() -> object:
        while True:
            yield 0.25

    status = Status("something", never(), clock, 3.0)  # type: ignore[arg-type]
    with pytest.raises(WaitTimedOut, match="waited 3 s for something, which is 25 % done"):
        status.wait()
    assert status.done
    assert status.update()


def test_records_refuse_what_cannot_be() -> None:
    with pytest.raises(InvalidInput, match="both axes of stage 'stage' have the address 12"):
        replace(STAGE, tilt=replace(TILT, module=12))
    with pytest.raises(InvalidInput, match="only PowerCubes can"):
        replace(STAGE, protocol="ptu46", start="on-signal")
    with pytest.raises(InvalidInput, match="does not contain its home position"):
        Axis(1, 0.5, 1.0)
    with pytest.raises(InvalidInput, match="1 to 31"):
        replace(STAGE, pan=replace(PAN, module=40))
    with pytest.raises(InvalidInput, match="2 instruments are called 'stage'"):
        Instruments(stages=(STAGE, STAGE))
    wired = replace(STAGE, link=SerialLink("/dev/ttyUSB0"))
    with pytest.raises(InvalidInput, match="'stage' and 'other' both use port /dev/ttyUSB0"):
        Instruments(stages=(wired, replace(wired, name="other")))
