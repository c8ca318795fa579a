"""The thread that carries out plans adds a state at each level at which a channel stays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import select, update
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.measuring import planned_recordings
from sms_jobs.app.measuring.planned_recordings import AtLevels, AtLoad, InTime
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import NotFound
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.devices import locks
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.planned_recordings import Dropped, PlannedRecording
from sms_jobs.records.units import typed
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.workers.planner import Planner

RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [
    { name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 },
    { name = "P2", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 },
]
file_channels = [{ name = "load_n", path = "LOAD", column = "load", unit = "kN" }]
"""
QUEUE = "rig-bench"
HOLD_S = 10.0
TURN_S = 2.0
"""Between two looks, at each of which the channel is read: less than a gap after which a hold begins anew."""


@pytest.fixture
def services(home: Path, tmp_path: Path) -> Iterator[Services]:
    """A home with two tests on one rig, each with a state S00."""
    initialised(home)
    (tmp_path / "rig.toml").write_text(RIG.replace("LOAD", str(tmp_path / "load.csv")))
    with bootstrap.services(home) as found:
        found.stations.add(tmp_path / "rig.toml", replace=False)
        for name in ("wing", "tail"):
            calibration, campaign = small_plate(name)
            rig = replace(calibration.rig, name="bench")
            register_campaign(
                found.catalogue,
                found.archive,
                replace(campaign, rig="bench", states=(LoadState("S00", 0.0),)),
                replace(calibration, rig=rig),
                datetime.now(UTC),
            )
        yield found


@pytest.fixture
def stays(
    services: Services, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[float, float], list[str]]:
    """Return what lets the channel read a load for so many seconds, and returns the states that were added.

    Of each that begins the recording ends at once.
    """
    clock = SimpleNamespace(monotonic=lambda: clock.now, now=1000.0)
    monkeypatch.setattr("sms_jobs.workers.planner.time", clock)
    planner = Planner(services, "w1", lambda: ["cpu", QUEUE])

    def stay(load_kn: float, seconds: float) -> list[str]:
        reads(tmp_path, load_kn)
        before = states(services)
        until = clock.now + seconds
        while clock.now < until:
            planner.look(datetime.now(UTC))
            planner.read()
            clock.now += TURN_S
            if recorded(services, JobState.QUEUED):
                end(services)
        return [label for label in states(services) if label not in before]

    return stay


def reads(tmp_path: Path, load_kn: float) -> None:
    (tmp_path / "load.csv").write_text(f"load\n{load_kn}\n")


def plan(services: Services, campaign: str = "wing", hold_s: float = HOLD_S) -> None:
    each = AtLevels("load_n", typed("10kN", "it"), typed("200N", "it"), hold_s)
    planned_recordings.plan(services, campaign, each)


def states(services: Services, campaign: str = "wing") -> dict[str, float | None]:
    with services.catalogue.reading() as session:
        return {s.label: s.load_n for s in definition(campaign_row(session, campaign)).states}


def recorded(services: Services, state: JobState) -> list[str]:
    with services.catalogue.reading() as session:
        return list(session.scalars(select(JobRow.subject).where(JobRow.state == state)))


def end(services: Services) -> None:
    with services.catalogue.writing() as session:
        session.execute(update(JobRow).values(state=JobState.SUCCEEDED))


def following(services: Services, campaign: str = "wing") -> PlannedRecording:
    return next(one for one in planned_recordings.show(services, campaign) if one.is_next)


def test_up_and_down_again_gives_a_state_for_each_load(
    services: Services, stays: Callable[[float, float], list[str]]
) -> None:
    plan(services)
    for load_kn in (0.0, 10.0, 20.0, 10.0, 0.0):
        assert stays(load_kn - 4.0, 20.0) == []  # on its way
        assert len(stays(load_kn + 0.1, HOLD_S + 3 * TURN_S)) == 1
    added = list(states(services).items())[1:]
    assert added == [("S01", 0.0), ("S02", 1e4), ("S03", 2e4), ("S04", 1e4), ("S05", 0.0)]
    assert recorded(services, JobState.SUCCEEDED) == [f"wing/{label}" for label, _ in added]


def test_a_long_hold_and_a_drift_within_it_give_one_state(
    services: Services, stays: Callable[[float, float], list[str]]
) -> None:
    plan(services)
    assert stays(10.19, 60.0) == ["S01"]
    for drift_kn in (0.1, 0.0, -0.1, -0.19):
        assert stays(10.0 + drift_kn, 60.0) == []
    # Out of the tolerance and back: no other load was reached meanwhile.
    assert stays(9.5, 60.0) == []
    assert stays(10.0, 60.0) == []
    assert stays(10.05, 300.0) == []
    assert list(states(services)) == ["S00", "S01"]


def test_a_load_that_is_only_passed_gives_none(
    services: Services, stays: Callable[[float, float], list[str]]
) -> None:
    plan(services)
    assert [stays(load_kn, HOLD_S - TURN_S) for load_kn in (10.0, 20.0, 10.0)] == [[], [], []]


def test_planned_states_come_first(services: Services, stays: Callable[[float, float], list[str]]) -> None:
    plan(services)
    planned_recordings.plan(services, "wing", InTime(), ["S00"])
    planned_recordings.hold(services, "wing", ["S00"])
    assert stays(10.0, 60.0) == []
    assert following(services).state == "S00"
    planned_recordings.go(services, "wing")
    assert stays(10.0, 60.0) == ["S01"]
    assert recorded(services, JobState.SUCCEEDED) == ["wing/S00", "wing/S01"]


def test_a_plan_that_is_held_back_or_dropped_adds_nothing(
    services: Services, stays: Callable[[float, float], list[str]]
) -> None:
    plan(services)
    assert planned_recordings.hold(services, "wing") == ["S01"]
    assert stays(10.0, 60.0) == []
    assert following(services).status == "held"
    assert planned_recordings.go(services, "wing") == ["S01"]
    assert stays(10.0, 60.0) == ["S01"]
    assert planned_recordings.drop(services, "wing") == Dropped(("S02",), recorded=("S01",))
    assert stays(20.0, 60.0) == []
    assert (list(states(services)), planned_recordings.show(services, "wing")) == (["S00", "S01"], [])


def test_a_supervisor_that_comes_later_goes_on(
    services: Services, stays: Callable[[float, float], list[str]], tmp_path: Path
) -> None:
    plan(services, hold_s=0.0)
    assert stays(10.0, 10.0) == ["S01"]
    other = Planner(services, "w2", lambda: [QUEUE])
    for load_kn in (10.0, 20.0):
        reads(tmp_path, load_kn)
        # One that is there already holds the rig, and is gone once its planner let go.
        with services.catalogue.writing() as session:
            locks.release(session, holder="the plan of wing, worker w1")
        other.look(datetime.now(UTC))
        other.read()
    assert list(states(services)) == ["S00", "S01", "S02"]


def test_levels_wait_for_the_plans_of_other_tests_on_their_rig(
    services: Services, stays: Callable[[float, float], list[str]]
) -> None:
    plan(services, "tail")
    plan(services, "wing")
    assert stays(5.0, 2 * TURN_S) == []
    assert "the plan of wing watches rig bench first" in following(services, "tail").waits_for
    # Levels have no end: states that are planned go before those of any test.
    planned_recordings.plan(services, "tail", AtLoad("load_n", typed("200N", "it"), HOLD_S))
    assert stays(5.0, 2 * TURN_S) == []
    assert "the plan of tail watches rig bench first" in following(services).waits_for


def test_what_could_not_begin_is_told_before_the_load_has_come(
    services: Services, stays: Callable[[float, float], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan(services)
    with monkeypatch.context() as patch:
        patch.setattr("sms_jobs.jobs.recording.reached_levels.drafted", _refuse)
        assert stays(10.0, 60.0) == []
    assert "there is no calibration" in following(services).waits_for
    assert stays(10.0, 60.0) == ["S01"]


def test_a_channel_that_does_not_answer_is_told(
    services: Services, stays: Callable[[float, float], list[str]], tmp_path: Path
) -> None:
    plan(services)
    stays(5.0, 2 * TURN_S)
    (tmp_path / "load.csv").write_text("cycles\n5\n")
    planner = Planner(services, "w1", lambda: [QUEUE])
    planner.look(datetime.now(UTC))
    planner.read()
    assert "load" in following(services).note


def _refuse(*_: object) -> None:
    raise NotFound("there is no calibration")
