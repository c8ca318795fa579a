"""The same of every driver over its simulator: in memory on a simulated clock, and on a pseudo-terminal.

On the pseudo-terminal bytes go through the operating system and pyserial as they do to a device on the bench.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from math import pi, radians
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sms_jobs.errors import DeviceFault, InstrumentError, InvalidInput, LimitExceeded, LinkLost
from sms_jobs.instruments.clock import Clock, RealClock, SimulatedClock
from sms_jobs.instruments.devices.connecting import Connector
from sms_jobs.instruments.devices.emergency_stop import emergency_stop
from sms_jobs.instruments.devices.pan_tilt import PanTilt
from sms_jobs.instruments.operation_log import OperationLog
from sms_jobs.instruments.simulated.serial.simulation import SerialSimulation, simulate
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.records.instruments import (
    Axis,
    Instruments,
    SerialChannel,
    Settling,
    Stage,
    TriggerController,
    VideoSplitter,
)
from sms_jobs.records.serial_links import Fault, LineProtocol, SerialLink, Wire

LINK = SerialLink("simulated", baud_rate=38400, reply_timeout_s=0.1, retries=2)
PAN = Axis(12, radians(-120.0), radians(120.0), velocity_rad_s=8.0, acceleration_rad_s2=100.0)
TILT = Axis(13, radians(-108.0), radians(108.0), velocity_rad_s=8.0, acceleration_rad_s2=100.0)
SETTLING = Settling(radians(0.02), for_s=0.1, timeout_s=1.5)
STAGES = {
    "powercube": Stage("stage", LINK, "powercube", PAN, TILT, settling=SETTLING),
    "powercube-carmen": Stage("stage", LINK, "powercube", PAN, TILT, checksum="carmen", settling=SETTLING),
    "powercube-on-signal": Stage("stage", LINK, "powercube", PAN, TILT, start="on-signal", settling=SETTLING),
    "schunk-motion": Stage("stage", LINK, "schunk-motion", PAN, TILT, settling=SETTLING),
    "ptu46": Stage("stage", LINK, "ptu46", PAN, TILT, settling=SETTLING),
}
PLAIN = LineProtocol(terminator="\r", reply_terminator=">", accepted=r"OK$", refused=r"Error (?P<error>.*)")
CHECKED = LineProtocol(
    prefix="@", checksum="sum", reply_checksum=True, accepted=r"^O", refused=r"^N(?P<error>.*)"
)
TRIGGERS = {
    "plain": TriggerController(
        "box", LINK, PLAIN, (Wire("C1", 1), Wire("C2", 2)), "fire {output}", configure=("mode ext",)
    ),
    "checked": TriggerController(
        "box", LINK, CHECKED, (Wire("C1", 0), Wire("C2", 1)), "TR", select="S{output:02d}", configure=("W1",)
    ),
}
SPLITTER = VideoSplitter("switch", LINK, PLAIN, (Wire("P1", 1), Wire("P2", 2)), "out {output}", settle_s=0.05)
# A fixed width, so that a digit that is lost is noticed: the line has no checksum.
FORM = r"^(?P<value>[-+]\d{3,6}\.\d{3})(?P<unit>[a-zA-Z]+)$"
LOAD = SerialChannel(
    "load", LINK, LineProtocol(), "N", request="?", reply=FORM, reported_unit="kN", scale=1000.0
)
STREAM = replace(LOAD, request="")
CHECKED_LOAD = replace(LOAD, protocol=CHECKED)


@dataclass
class Bench:
    """Where a device is tested: its wire, its clock, and what is behind it."""

    connector: Connector
    simulation: SerialSimulation
    clock: Clock
    log: OperationLog
    instrument: Any

    def stage(self) -> PanTilt:
        device = self.connector.stage(self.instrument)
        device.connect()
        return device


def _cases(*stages: str, quick: tuple[str, ...] = ()) -> list[Any]:
    """Return carriers and stages; those that are not quick take real time and are left to the long run."""
    in_memory = [pytest.param("memory", name) for name in stages]
    marks = {name: () if name in quick else (pytest.mark.long,) for name in stages}
    return in_memory + [pytest.param("pseudo-terminal", name, marks=marks[name]) for name in stages]


MAKES = ("powercube", "schunk-motion", "ptu46")
THOROUGH: dict[Any, Any] = {"memory": (), "pseudo-terminal": (pytest.mark.long,)}
# A PTU-46 does not say that it is blocked (see the tests of the stage), and refers itself at power-on.
THAT_HOME = tuple(name for name in STAGES if name != "ptu46")
everywhere = pytest.mark.parametrize(
    ("carrier", "stage"), _cases(*STAGES, quick=("powercube",)), indirect=True
)
one_in_real_time = pytest.mark.parametrize(
    ("carrier", "stage"), _cases(*STAGES, quick=("powercube",)), indirect=True
)
mostly_in_memory = pytest.mark.parametrize(("carrier", "stage"), _cases(*STAGES), indirect=True)
with_faults_of_modules = pytest.mark.parametrize(
    ("carrier", "stage"), _cases(*THAT_HOME, quick=("powercube",)), indirect=True
)


def _faults(*faults: str | None) -> list[Any]:
    """Return carriers and faults; in real time only none at all is quick enough."""
    quick = (None,)
    return [pytest.param("memory", fault) for fault in faults] + [
        pytest.param("pseudo-terminal", fault, marks=() if fault in quick else (pytest.mark.long,))
        for fault in faults
    ]


@pytest.fixture(params=["memory", "pseudo-terminal"])
def carrier(request: pytest.FixtureRequest) -> str:
    if request.param == "pseudo-terminal" and sys.platform == "win32":
        pytest.skip("Windows has no pseudo-terminals")
    return str(request.param)


def late(fault: Fault) -> bool:
    return fault.fault == "late-reply"


@pytest.fixture
def bench_of(carrier: str) -> Iterator[Any]:
    with ExitStack() as stack:

        def make(instrument: Any, *faults: Fault, value: float = 1955.0) -> Bench:
            instrument = replace(instrument, faults=faults)
            kind = {Stage: "stages", TriggerController: "triggers", VideoSplitter: "splitters"}
            rig = Instruments(**{kind.get(type(instrument), "channels"): (instrument,)})
            values = {"load": lambda _now: 1000.0 * value}
            if carrier == "memory":
                clock: Clock = SimulatedClock()
                simulation = SerialSimulation(rig, clock, values)
                log = OperationLog(clock)
                return Bench(Connector(clock, log, simulation), simulation, clock, log, instrument)
            # In real time on a busy machine a reply may wait for its turn: three times as long for all.
            slow = tuple(replace(fault, amount=3.0 * fault.amount) for fault in faults if late(fault))
            others = tuple(fault for fault in faults if not late(fault))
            instrument = replace(instrument, faults=slow + others)
            rig = Instruments(**{kind.get(type(instrument), "channels"): (instrument,)})
            ports = stack.enter_context(simulate(rig, values=values))
            clock = RealClock()
            timeout_s = 3.0 * instrument.link.reply_timeout_s
            link = replace(instrument.link, port=ports.ports[0].path, reply_timeout_s=timeout_s)
            log = OperationLog(clock)
            on_port = replace(instrument, link=link)
            return Bench(Connector(clock, log), ports.simulation, clock, log, on_port)

        yield make


@pytest.fixture
def stage(request: pytest.FixtureRequest) -> Stage:
    return STAGES[request.param]


@everywhere
def test_a_stage_goes_where_it_is_told(bench_of: Any, stage: Stage) -> None:
    bench = bench_of(stage)
    device = bench.stage()
    device.stage()
    status = device.set(StagePose(0.3, -0.2))
    assert not status.done
    status.wait()
    assert status.progress == 1.0
    # The tolerance of settling, and half a count of the coarsest encoder (0.0514 degrees).
    tolerance = SETTLING.tolerance_rad + radians(0.0257)
    assert device.angles() == pytest.approx((0.3, -0.2), abs=tolerance)
    # Where it says it is, it is: apart from its encoder, and what is left of a drift within the tolerance.
    assert bench.simulation.angles("stage") == pytest.approx((0.3, -0.2), abs=2 * tolerance)
    device.home()
    assert device.angles() == pytest.approx((0.0, 0.0), abs=tolerance)
    description = device.describe()
    assert description.name == "stage"
    assert len(description.facts) == 4
    assert {name for name, _unit in description.units} == {r.name for r in device.read()}
    assert [o.operation for o in bench.log.operations][-2:] == ["move", "move"]
    assert {o.outcome for o in bench.log.operations} == {"done"}
    device.close()


@pytest.mark.parametrize(
    ("carrier", "stage", "fault"),
    [
        pytest.param(
            *case.values, fault, marks=case.marks if fault == "late-reply" else THOROUGH[case.values[0]]
        )
        for case in _cases(*STAGES, quick=MAKES)
        for fault in ("dropped-byte", "garbled-byte", "wrong-checksum", "late-reply")
    ],
    indirect=["carrier", "stage"],
)
def test_one_bad_reply_does_no_harm(bench_of: Any, stage: Stage, fault: Any, carrier: str) -> None:
    # In memory at any of the first replies, whatever is being asked then; in real time at one.
    for at in range(1, 41) if carrier == "memory" else [9]:
        bench = bench_of(stage, Fault(fault, at=at, amount=0.15))
        device = bench.stage()
        device.stage()
        device.move(0.1, 0.1)
        assert device.angles() == pytest.approx((0.1, 0.1), abs=radians(0.06))
        device.close()


def _ask_often(device: PanTilt) -> None:
    for _ in range(40):
        device.angles()


@pytest.mark.parametrize("stage", list(STAGES), indirect=True)
@given(
    faults=st.lists(
        st.builds(
            Fault,
            st.sampled_from(["dropped-byte", "garbled-byte", "wrong-checksum", "late-reply", "unplugged"]),
            at=st.integers(1, 120),
            times=st.integers(1, 4),
            amount=st.floats(0.0, 0.5),
        ),
        max_size=6,
    )
)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_whatever_befalls_the_wire_it_arrives_or_says_so(stage: Stage, faults: list[Fault]) -> None:
    if stage.protocol == "ptu46":
        # Without a checksum a digit that is lost twice alike cannot be noticed.
        faults = [fault for fault in faults if fault.fault != "dropped-byte"]
    stage = replace(stage, faults=tuple(faults))
    clock = SimulatedClock()
    simulation = SerialSimulation(Instruments(stages=(stage,)), clock)
    device = Connector(clock, None, simulation).stage(stage)
    with suppress(InstrumentError):  # whatever else is raised is a defect
        device.connect()
        device.stage()
        device.move(0.3, -0.2)
        # In truth, not only by what it says: the tolerance of settling, half a count, the rest of a drift.
        assert simulation.angles("stage") == pytest.approx((0.3, -0.2), abs=radians(0.08))
    # Nothing takes for ever: at worst every question is asked in vain three times.
    assert clock.monotonic() < 300.0


@one_in_real_time
def test_an_unplugged_cable_is_reported_and_can_be_plugged_in_again(bench_of: Any, stage: Stage) -> None:
    # Two retries: three requests of one question go unanswered, and then the cable is back.
    bench = bench_of(stage, Fault("unplugged", at=60, times=3))
    device = bench.stage()
    device.stage()
    with pytest.raises(LinkLost, match=r"'stage' .* did not answer 3 times .* nothing came: .* cable"):
        _ask_often(device)
    device.move(0.1, 0.1)
    assert device.angles() == pytest.approx((0.1, 0.1), abs=radians(0.06))
    device.close()


@mostly_in_memory
def test_a_pose_out_of_reach_is_refused(bench_of: Any, stage: Stage) -> None:
    bench = bench_of(stage)
    device = bench.stage()
    device.stage()
    before = device.angles()
    with pytest.raises(LimitExceeded, match=r"pan .* 2\.6180 rad, beyond its range"):
        device.set(StagePose(radians(150.0), 0.0))
    assert device.angles() == pytest.approx(before, abs=radians(0.06))
    # 315 degrees are -45 degrees.
    device.move(radians(359.0), 0.0)
    assert device.angles()[0] == pytest.approx(radians(-1.0), abs=radians(0.06))
    device.close()


@mostly_in_memory
def test_a_servo_that_hunts_settles_when_it_is_told_again(bench_of: Any, stage: Stage) -> None:
    bench = bench_of(stage, Fault("hunting-servo", at=1, times=1, amount=radians(0.3)))
    device = bench.stage()
    device.stage()
    device.move(0.2, 0.0)
    assert device.angles()[0] == pytest.approx(0.2, abs=radians(0.06))
    device.close()


@mostly_in_memory
def test_a_servo_that_hunts_on_is_reported(bench_of: Any, stage: Stage) -> None:
    bench = bench_of(stage, Fault("hunting-servo", times=0, axis="tilt", amount=radians(0.3)))
    device = bench.stage()
    device.stage()
    with pytest.raises(DeviceFault, match=r"hunts: after 2 attempts .* tilt is off by up to"):
        device.move(0.2, 0.1)
    assert "hunts" in bench.log.operations[-1].outcome
    device.close()


@with_faults_of_modules
def test_an_axis_that_is_blocked_stops_all(bench_of: Any, stage: Stage) -> None:
    bench = bench_of(stage, Fault("tow-error", at=1, axis="tilt"))
    device = bench.stage()
    device.stage()
    with pytest.raises(DeviceFault, match=r"tilt axis of 'stage' stopped at 0\.\d+ rad"):
        device.move(0.0, 0.8)
    with pytest.raises(DeviceFault):
        device.move(0.0, 0.8)
    device.recover()
    device.move(0.0, 0.8)
    assert device.angles()[1] == pytest.approx(0.8, abs=radians(0.06))
    device.close()


@with_faults_of_modules
def test_a_home_position_that_is_not_found_is_reported(bench_of: Any, stage: Stage) -> None:
    bench = bench_of(stage, Fault("never-homed", at=1, axis="tilt"))
    device = bench.stage()
    with pytest.raises(DeviceFault, match=r"tilt axis of 'stage' stands .* reference switch"):
        device.stage()
    device.stage()
    assert device.angles() == pytest.approx((0.0, 0.0), abs=radians(0.06))
    device.close()


@one_in_real_time
def test_a_stop_ends_a_move(bench_of: Any, stage: Stage) -> None:
    bench = bench_of(replace(stage, pan=replace(PAN, velocity_rad_s=1.0)))
    device = bench.stage()
    device.stage()
    status = device.set(StagePose(2.0, 0.0))
    for _ in range(3):
        status.update()
        bench.clock.sleep(0.05)
    device.stop()
    with pytest.raises(DeviceFault, match="was stopped"):
        status.wait()
    assert 0.0 < device.angles()[0] < 1.9
    device.move(0.1, 0.0)
    assert device.angles()[0] == pytest.approx(0.1, abs=radians(0.06))
    device.close()


@pytest.mark.parametrize(("carrier", "stage"), [("pseudo-terminal", name) for name in MAKES], indirect=True)
def test_an_emergency_stop_asks_nobody(bench_of: Any, stage: Stage) -> None:
    # The stage is moving, and its port belongs to the program that moves it.
    bench = bench_of(replace(stage, pan=replace(PAN, velocity_rad_s=1.0)))
    device = bench.stage()
    device.stage()
    status = device.set(StagePose(2.0, 0.0))
    status.update()
    assert emergency_stop([bench.instrument], bench.clock) == ("stage",)
    stopped_at = bench.simulation.angles("stage")[0]
    assert stopped_at < 1.9
    if stage.protocol != "ptu46":  # which does not say so, and is missed when it should have arrived
        with pytest.raises(DeviceFault, match=r"axis of 'stage' stopped"):
            status.wait()
    # After 0.1 s of drift it stands where it stopped.
    bench.clock.sleep(0.2)
    assert bench.simulation.angles("stage")[0] == pytest.approx(stopped_at, abs=radians(0.2))
    device.recover()
    device.move(0.1, 0.0)
    device.close()


@pytest.mark.parametrize("kind", list(TRIGGERS))
@pytest.mark.parametrize(
    ("carrier", "fault"), _faults(None, "garbled-byte", "wrong-checksum", "late-reply"), indirect=["carrier"]
)
def test_a_controller_triggers_what_is_wired(bench_of: Any, kind: str, fault: Any) -> None:
    # The reply to the first trigger: the controller was configured before, and selected if it can be.
    faults = [Fault(fault, at=3 if kind == "checked" else 2, amount=0.15)] if fault else []
    bench = bench_of(TRIGGERS[kind], *faults)
    device = bench.connector.trigger_controller(bench.instrument)
    device.connect()
    device.fire(["C2"])
    device.fire(["C2"])
    wired = 2 if kind == "plain" else 1
    # Once each, whatever became of the reply: a camera must not expose twice.
    assert [output for _, output in bench.simulation.controller("box").triggers] == [wired, wired]
    with pytest.raises(InvalidInput, match=r"C3 is not wired to 'box'"):
        device.fire(["C3"])
    assert len(device.describe().facts) == 2
    device.close()


def test_a_controller_that_refuses_says_so(bench_of: Any) -> None:
    bench = bench_of(replace(TRIGGERS["plain"], configure=()))
    device = bench.connector.trigger_controller(replace(bench.instrument, configure=("mode ext",)))
    with pytest.raises(DeviceFault, match=r"'box' refuses 'mode ext' with error '1: unknown command'"):
        device.connect()
    device.close()


@pytest.mark.parametrize(
    ("carrier", "fault"), _faults(None, "garbled-byte", "late-reply"), indirect=["carrier"]
)
def test_a_splitter_feeds_one_projector(bench_of: Any, fault: Any) -> None:
    bench = bench_of(SPLITTER, *([Fault(fault, at=2, amount=0.15)] if fault else []))
    device = bench.connector.video_splitter(bench.instrument)
    device.connect()
    began = bench.clock.monotonic()
    device.set("P2").wait()
    assert bench.simulation.controller("switch").selected == 2
    assert bench.clock.monotonic() - began >= SPLITTER.settle_s
    device.close()


@pytest.mark.parametrize("channel", [LOAD, STREAM, CHECKED_LOAD], ids=["asked", "by-itself", "checked"])
@pytest.mark.parametrize(
    ("carrier", "fault"),
    _faults(None, "dropped-byte", "garbled-byte", "wrong-checksum", "late-reply"),
    indirect=["carrier"],
)
def test_a_channel_tells_its_value(bench_of: Any, channel: SerialChannel, fault: Any) -> None:
    bench = bench_of(channel, *([Fault(fault, at=2, amount=0.15)] if fault else []))
    device = bench.connector.channel(bench.instrument)
    device.connect()
    for _ in range(3):
        [reading] = device.read()
        assert reading.value == pytest.approx(1_955_000.0, abs=1e-6)  # 1955.000 kN, exact in three decimals
        assert reading.unit == "N"
        # A value is as old as its way over the wire at most.
        assert abs((bench.clock.now() - reading.time).total_seconds()) < 1.0
    device.close()


def test_a_channel_in_another_unit_is_refused(bench_of: Any) -> None:
    bench = bench_of(LOAD)
    device = bench.connector.channel(replace(bench.instrument, reported_unit="lbf"))
    with pytest.raises(DeviceFault, match="'load' reports in kN and not in lbf"):
        device.connect()
    device.close()


@pytest.mark.parametrize(
    "instrument", [TRIGGERS["checked"], SPLITTER, LOAD, STREAM], ids=["box", "switch", "load", "stream"]
)
def test_a_device_that_is_not_there_is_reported(bench_of: Any, instrument: Any) -> None:
    bench = bench_of(instrument, Fault("unplugged", times=0))
    make = {
        TriggerController: bench.connector.trigger_controller,
        VideoSplitter: bench.connector.video_splitter,
        SerialChannel: bench.connector.channel,
    }[type(instrument)]
    device = make(bench.instrument)
    with pytest.raises(LinkLost, match=rf"'{instrument.name}' .* cable"):
        device.connect()
    device.close()


def test_a_turn_is_a_turn() -> None:
    with pytest.raises(InvalidInput, match="one turn"):
        Axis(1, -pi, 1.1 * pi)
