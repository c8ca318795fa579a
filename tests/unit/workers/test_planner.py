"""The thread that carries out plans watches what it may, and says what keeps it from that."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import select
from support.command import wait_until
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.measuring import planned_recordings
from sms_jobs.app.measuring.planned_recordings import AtCycles, AtLoad, InTime, When
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.planned import PlannedRecordingRow
from sms_jobs.errors import LinkLost, NotFound
from sms_jobs.instruments.connection import channel_reader
from sms_jobs.instruments.simulated.serial.simulation import simulate
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.recording import due_recordings, watched_rigs
from sms_jobs.jobs.running import queues
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.shown.planned_recordings import PlannedRecording
from sms_jobs.records.units import typed
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.workers.planner import Planner
from sms_jobs.workers.planning import Planning

RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [
    { name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 },
    { name = "P2", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 },
]
file_channels = [
    { name = "load_n", path = "LOAD", column = "load", unit = "N" },
    { name = "cycles", path = "LOAD", column = "cycles", unit = "1" },
]
"""
SERIAL = """
[[channels]]
name = "load_n"
link = { port = "PORT" }
protocol = { terminator = "\\r", reply_terminator = "\\r\\n" }
request = "L?"
unit = "N"
"""
QUEUE = "rig-bench"


@pytest.fixture
def services(home: Path, tmp_path: Path) -> Iterator[Services]:
    """A home with two tests on one rig, at 0, 100 and 200 N."""
    initialised(home)
    (tmp_path / "rig.toml").write_text(RIG.replace("LOAD", str(tmp_path / "load.csv")))
    states = tuple(LoadState(f"S{n:02d}", 100.0 * n) for n in range(3))
    with bootstrap.services(home) as found:
        found.stations.add(tmp_path / "rig.toml", replace=False)
        for name in ("wing", "tail"):
            calibration, campaign = small_plate(name)
            rig = replace(calibration.rig, name="bench")
            register_campaign(
                found.catalogue,
                found.archive,
                replace(campaign, rig="bench", states=states),
                replace(calibration, rig=rig),
                datetime.now(UTC),
            )
        yield found


@pytest.fixture
def planner(services: Services) -> Planner:
    return Planner(services, "w1", lambda: ["cpu", QUEUE])


def reads(tmp_path: Path, load_n: float, cycles: int = 0) -> None:
    (tmp_path / "load.csv").write_text(f"load,cycles\n{load_n},{cycles}\n")


def at_load(hold_s: float = 0.0) -> AtLoad:
    return AtLoad("load_n", typed("5N", "it"), hold_s)


def turn(planner: Planner) -> None:
    planner.look(datetime.now(UTC))
    planner.read()


def following(services: Services, campaign: str = "wing") -> PlannedRecording:
    return next(one for one in planned_recordings.show(services, campaign) if one.is_next)


def recorded(services: Services) -> list[str]:
    with services.catalogue.reading() as session:
        return list(session.scalars(select(JobRow.subject)))


def rig_is_held_by(services: Services) -> list[str | None]:
    with services.catalogue.reading() as session:
        return [lock.holder for lock in locks.held_devices(session, datetime.now(UTC)) if lock.alive]


def test_the_thread_carries_out_the_first_plan_and_ends_when_asked(services: Services) -> None:
    planning = Planning(services, "w1", lambda: ["cpu", QUEUE])
    planning.start()
    try:
        planned_recordings.plan(services, "wing", InTime())
        wait_until(lambda: recorded(services) == ["wing/S00"])
    finally:
        planning.stop()
        planning.join(timeout=30.0)
    assert not planning.is_alive()


@pytest.mark.parametrize("when", [InTime(), InTime(600.0)])
def test_what_waits_for_no_channel_begins(services: Services, planner: Planner, when: When) -> None:
    planned_recordings.plan(services, "wing", when)
    for _ in range(3):
        turn(planner)
    assert recorded(services) == ["wing/S00"]  # the next one waits for it


def test_a_load_is_waited_for_and_the_rig_held_meanwhile(
    services: Services, planner: Planner, tmp_path: Path
) -> None:
    reads(tmp_path, 90.0)
    planned_recordings.plan(services, "wing", at_load(), ["S01"])
    turn(planner)
    turn(planner)
    assert (recorded(services), rig_is_held_by(services)) == ([], ["the plan of wing, worker w1"])
    reads(tmp_path, 96.0)
    turn(planner)
    # The rig is free for the recording in the same transaction.
    assert (recorded(services), rig_is_held_by(services)) == (["wing/S01"], [])


def test_who_follows_a_plan_is_told_once_of_a_wait(services: Services) -> None:
    planned_recordings.plan(services, "wing", at_load(), ["S01"])
    told = set()
    for load_n in (None, 90.0, 91.0):
        with services.catalogue.writing() as session:
            row = session.scalars(select(PlannedRecordingRow.id)).one()
            watched_rigs.note_reading(session, row, load_n, datetime.now(UTC))
        found = following(services)
        told.add(found.unless_read)
        read = "" if load_n is None else f"; it read {load_n:g} last"
        assert found.waits_for.replace(read, "", 1) == found.unless_read
        assert (found.waits_for == found.unless_read) is (load_n is None)
    assert len(told) == 1
    assert "no worker serves rig-bench" in told.pop()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_a_wire_is_let_go_of_before_the_recording_begins(
    services: Services, planner: Planner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, load_n = tmp_path / "ports" / "load_n", [90.0]
    head, _, _ = RIG.partition("file_channels")
    (tmp_path / "serial.toml").write_text(head + SERIAL.replace("PORT", str(link)))
    serial = services.stations.add(tmp_path / "serial.toml", replace=True).serial
    with simulate(serial, link.parent, {"load_n": lambda _now: load_n[0]}):
        planned_recordings.plan(services, "wing", at_load(), ["S01"])
        turn(planner)
        with pytest.raises(LinkLost), channel_reader(services.stations.rig("bench"), "load_n"):
            pass  # the wire is in use
        begin, free = due_recordings.begin, []

        def watched(*given: Any) -> str | None:
            with channel_reader(services.stations.rig("bench"), "load_n") as read:
                free.append(read())
            return begin(*given)

        monkeypatch.setattr("sms_jobs.workers.planner.due_recordings.begin", watched)
        load_n[0] = 99.0
        turn(planner)
    assert (free, recorded(services)) == ([99.0], ["wing/S01"])


def test_a_hold_is_in_the_unit_of_the_channels_name(
    services: Services, planner: Planner, tmp_path: Path
) -> None:
    in_kn = RIG.replace("LOAD", str(tmp_path / "load.csv")).replace('unit = "N"', 'unit = "kN"')
    (tmp_path / "rig.toml").write_text(in_kn)
    services.stations.add(tmp_path / "rig.toml", replace=True)
    planned_recordings.plan(services, "wing", at_load(), states=("S01",))
    reads(tmp_path, 100.0)  # kN
    turn(planner)
    assert recorded(services) == []
    reads(tmp_path, 0.1)
    turn(planner)
    assert recorded(services) == ["wing/S01"]


def test_a_count_is_waited_for(services: Services, planner: Planner, tmp_path: Path) -> None:
    reads(tmp_path, 0.0, 999)
    planned_recordings.plan(services, "wing", AtCycles((1000,), "cycles", 0.0))
    turn(planner)
    assert recorded(services) == []
    reads(tmp_path, 0.0, 1003)
    turn(planner)
    assert recorded(services) == ["wing/S00"]


def test_a_channel_that_does_not_answer_is_told_and_asked_again(
    services: Services, planner: Planner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sms_jobs.workers.planner._CONNECT_AGAIN_S", 0.0)
    planned_recordings.plan(services, "wing", at_load())
    turn(planner)
    assert "load.csv, which 'load_n' reads, cannot be read" in following(services).waits_for
    reads(tmp_path, 0.0)
    turn(planner)
    assert recorded(services) == ["wing/S00"]


def test_a_hold_begins_anew_where_the_channel_was_away(
    services: Services, planner: Planner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(monotonic=lambda: clock.now, now=1000.0)
    monkeypatch.setattr("sms_jobs.workers.planner.time", clock)
    monkeypatch.setattr("sms_jobs.workers.planner._CONNECT_AGAIN_S", 0.0)
    reads(tmp_path, 0.0)
    planned_recordings.plan(services, "wing", at_load(10.0))
    for clock.now in (1000.0, 1003.0, 1006.0):
        turn(planner)
    (tmp_path / "load.csv").rename(tmp_path / "gone")
    clock.now = 1007.0
    turn(planner)
    (tmp_path / "gone").rename(tmp_path / "load.csv")
    for clock.now in (1008.0, 1011.0, 1014.0, 1017.0):
        turn(planner)
    assert recorded(services) == []
    clock.now = 1018.0
    turn(planner)
    assert recorded(services) == ["wing/S00"]


def test_nothing_is_watched_in_the_way_of_others(
    services: Services, planner: Planner, tmp_path: Path
) -> None:
    reads(tmp_path, 90.0)
    planned_recordings.plan(services, "wing", at_load())
    planned_recordings.plan(services, "tail", at_load())
    turn(planner)
    assert "the plan of wing watches rig bench first" in following(services, "tail").waits_for
    other = Planner(services, "w2", lambda: [QUEUE])
    turn(other)
    assert "the plan of wing, worker w1' has held" in following(services).waits_for
    planned_recordings.drop(services, "tail")
    with services.catalogue.writing() as session:
        queues.pause(session, QUEUE, "tea", datetime.now(UTC))
    turn(planner)
    assert "the queue rig-bench is paused" in following(services).waits_for
    assert rig_is_held_by(services) == []


def test_a_plan_that_is_held_back_or_changed_lets_the_rig_go(
    services: Services, planner: Planner, tmp_path: Path
) -> None:
    reads(tmp_path, 90.0)
    planned_recordings.plan(services, "wing", at_load())
    turn(planner)
    assert len(rig_is_held_by(services)) == 1
    planned_recordings.hold(services, "wing")
    turn(planner)
    assert rig_is_held_by(services) == []
    planned_recordings.go(services, "wing")
    planned_recordings.move(services, "wing", "S01", "S00")
    reads(tmp_path, 100.0)
    turn(planner)
    assert recorded(services) == ["wing/S01"]


def test_what_could_not_begin_is_told_before_the_load_has_come(
    services: Services, planner: Planner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads(tmp_path, 90.0)
    planned_recordings.plan(services, "wing", at_load())
    other = Planner(services, "w1", lambda: ["cpu"])
    turn(other)
    assert rig_is_held_by(services) == []  # it serves no rig
    monkeypatch.setattr("sms_jobs.workers.planner.due_recordings.rehearse", _refuse)
    turn(planner)
    assert "there is no calibration" in following(services).waits_for


def _refuse(*_: object) -> None:
    raise NotFound("there is no calibration")
