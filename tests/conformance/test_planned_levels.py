"""A state is added at each level that is held: once, whoever looks, whatever ends, on both databases."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime

import pytest
from sqlalchemy import select, update
from support.archives import PLAN, Clock, emptied, registered
from support.deployments import Deployment
from support.jobs import NOW

from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow, ReadingRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.planned import PlannedLevelsRow, PlannedRecordingRow
from sms_jobs.errors import NotFound
from sms_jobs.jobs.archiving.importing import add_states
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.jobs.recording import (
    due_recordings,
    planned_levels,
    planned_recordings,
    quick_looks,
    reached_levels,
    shown_plans,
    watched_rigs,
)
from sms_jobs.jobs.recording.reached_levels import Added, DueLevels
from sms_jobs.records.campaign import CampaignDefinition, LoadState
from sms_jobs.records.gauge_limits import NO_LOOK, GaugeLimit, Look
from sms_jobs.records.job import JobState
from sms_jobs.records.levels import Levels
from sms_jobs.records.shown.planned_recordings import PlannedRecording
from sms_jobs.records.triggers import InTurn

LEVELS = Levels("load_n", "kN", 10.0, 0.2, 5.0)
LIMIT = GaugeLimit("g1", "extension_mm", True, 0.5)


@pytest.fixture
def archive(archive: Archive, catalogue: Catalogue, clock: Clock) -> Archive:
    """An archive with a campaign of two states, of which nothing is recorded; the catalogue knows it."""
    registered(catalogue, archive, clock)
    return archive


@pytest.fixture
def stepped(catalogue: Catalogue, archive: Archive) -> Catalogue:
    """A catalogue with that campaign, which is given a state at each 10 kN."""
    plan(catalogue)
    return catalogue


def plan(
    catalogue: Catalogue,
    levels: Levels = LEVELS,
    look: Look = NO_LOOK,
    at: datetime = NOW,
    process: bool = False,
) -> None:
    with catalogue.writing() as session:
        number = planned_recordings.lock(session, "plate")
        planned_levels.put(session, number, levels, "anna", at, ask=False, process=process, look=look)


def due(catalogue: Catalogue) -> DueLevels | None:
    with catalogue.reading() as session:
        return next(iter(reached_levels.due(session)), None)


def add(catalogue: Catalogue, archive: Archive, level: float) -> Added | None:
    one = due(catalogue)
    assert one is not None
    return reached_levels.add(catalogue, archive, one, level, NOW)


def shown(catalogue: Catalogue) -> list[PlannedRecording]:
    with catalogue.reading() as session:
        return shown_plans.list_planned(session, NOW, "plate")


def defined(catalogue: Catalogue) -> dict[str, LoadState]:
    """Return the states of the campaign; its rows tell the same as its definition."""
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, "plate")
        states = {state.label: state for state in campaigns.definition(row).states}
        assert set(campaigns.state_ids(session, row.id)) == set(states)
    return states


def recordings(catalogue: Catalogue) -> list[str]:
    with catalogue.reading() as session:
        return list(
            session.scalars(select(JobRow.subject).where(JobRow.kind == "acquire").order_by(JobRow.position))
        )


def end(catalogue: Catalogue, label: str, load_n: float | None, state: JobState = JobState.SUCCEEDED) -> None:
    """Let the recording of a state end; where it was measured, the rig has read a load meanwhile."""
    with catalogue.writing() as session:
        about = JobRow.kind == "acquire", JobRow.subject == f"plate/{label}"
        session.execute(update(JobRow).where(*about).values(state=state))
    if load_n is not None:
        measured(catalogue, label, load_n)
    due_recordings.settle(catalogue)


def measured(catalogue: Catalogue, label: str, load_n: float | None) -> None:
    with catalogue.writing() as session:
        number = campaigns.campaign_id(session, "plate")
        count = len(session.scalars(select(FileRow.id)).all())
        file = FileRow(
            source="measurement",
            path=f"plate/{label}/C1P1/{count}.h5",
            content_hash=f"{label}{count}",
            size_bytes=1,
            media_type="application/x-hdf5",
            created_at=NOW,
            campaign_id=number,
            state_id=campaigns.state_ids(session, number)[label],
            view="C1P1",
        )
        session.add(file)
        session.flush()
        if load_n is not None:
            session.add(ReadingRow(file_id=file.id, name="load_n", value=load_n))


def test_a_level_becomes_a_state_whose_recording_has_begun(stepped: Catalogue, archive: Archive) -> None:
    plan(stepped, process=True)
    before = defined(stepped)
    # What could not begin is told before the load has come: there is nothing to compare a state with.
    one = due(stepped)
    assert one is not None
    with pytest.raises(NotFound, match="S02/C1P1 needs the measurement of plate/S00/C1P1, and there is none"):
        reached_levels.rehearse(stepped, one, NOW)
    measured(stepped, "S00", None)
    reached_levels.rehearse(stepped, one, NOW)
    added = add(stepped, archive, 20.0)
    assert added is not None
    assert (added.label, list(defined(stepped).items())[:2]) == ("S02", list(before.items()))
    assert defined(stepped)["S02"] == LoadState("S02", 20_000.0)  # in the unit of the channel's name
    with stepped.reading() as session:
        row = session.scalars(select(PlannedRecordingRow)).one()
        kinds = set(session.scalars(select(JobRow.kind)))
        path = session.scalars(select(FileRow.path).where(FileRow.source == "campaign").order_by(FileRow.id))
        with archive.open_unrecorded(path.all()[-1]) as dataset:
            kept = dataset.read("campaign", CampaignDefinition)
    assert (row.status, row.job_id, row.planned_by) == ("begun", added.job_id, "anna")
    assert {"acquire", "reconstruct", "strain"} <= kinds  # and it is processed
    assert (kept.plan, kept.campaign.states[-1]) == (PLAN, LoadState("S02", 20_000.0))
    (one, following) = shown(stepped)
    assert (one.trigger, one.is_next, one.is_added) == ("load_n = 20 +- 0.2 kN for 5 s", True, False)
    assert (following.state, following.is_next, following.is_added) == ("S03", False, True)


def test_up_and_down_each_level_is_a_state_of_its_own(stepped: Catalogue, archive: Archive) -> None:
    for level in (0.0, 10.0, 20.0, 10.0, 0.0):
        added = add(stepped, archive, level)
        assert added is not None
        assert due(stepped) is None  # its recording is under way
        end(stepped, added.label, 1000.0 * level)
    states = list(defined(stepped).values())[2:]
    assert [(state.label, state.load_n) for state in states] == [
        ("S02", 0.0),
        ("S03", 10_000.0),
        ("S04", 20_000.0),
        ("S05", 10_000.0),
        ("S06", 0.0),
    ]
    assert recordings(stepped) == [f"plate/{state.label}" for state in states]


def test_of_many_who_see_a_level_at_once_one_adds_it(stepped: Catalogue, archive: Archive) -> None:
    one = due(stepped)
    assert one is not None
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: reached_levels.add(stepped, archive, one, 10.0, NOW), range(4)))
    assert len([added for added in found if added is not None]) == 1
    assert (list(defined(stepped)), recordings(stepped)) == (["S00", "S01", "S02"], ["plate/S02"])
    assert reached_levels.add(stepped, archive, one, 10.0, NOW) is None


def test_who_adds_another_state_meanwhile_loses_none(stepped: Catalogue, archive: Archive) -> None:
    one = due(stepped)
    assert one is not None
    labels = [f"X{number}" for number in range(3)]
    with ThreadPoolExecutor(4) as pool:
        others = [pool.submit(add_states, stepped, archive, "plate", [label], NOW) for label in labels]
        added = pool.submit(reached_levels.add, stepped, archive, one, 10.0, NOW).result()
        for other in others:
            other.result()
    assert added is not None
    assert added.label in defined(stepped)
    assert set(labels) <= set(defined(stepped))
    assert recordings(stepped) == [f"plate/{added.label}"]


def test_what_was_changed_meanwhile_adds_nothing(stepped: Catalogue, archive: Archive) -> None:
    one = due(stepped)
    assert one is not None

    def late() -> bool:
        return reached_levels.add(stepped, archive, one, 10.0, NOW) is None

    with stepped.writing() as session:
        assert planned_recordings.set_held(session, "plate", [], True) == ["S02"]
    assert late()
    with stepped.writing() as session:
        assert planned_recordings.set_held(session, "plate", [], False) == ["S02"]
        planned_recordings.put(session, "plate", [("S01", InTurn())], "anna", NOW)
    assert late()  # states that are planned come first
    with stepped.writing() as session:
        assert planned_recordings.drop(session, "plate", []).forgotten == ("S01", "S02")
    assert late()
    plan(stepped, at=NOW.replace(year=2027))
    measured(stepped, "S00", 10_100.0)
    assert late()  # it was recorded by hand
    assert (len(defined(stepped)), recordings(stepped)) == (2, [])


@pytest.mark.parametrize("moment", ["enter", "newest_measurement", "release"])
def test_where_it_breaks_off_nothing_is_left_of_it(
    stepped: Catalogue, archive: Archive, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    one = due(stepped)
    assert one is not None
    places = {
        "enter": "sms_jobs.jobs.recording.reached_levels.enter",
        "newest_measurement": "sms_jobs.jobs.recording.planned_levels.newest_measurement",
        "release": "sms_jobs.jobs.devices.locks.release",
    }
    before = sorted(archive.store.names())
    with monkeypatch.context() as patch:
        patch.setattr(places[moment], _fails)
        with pytest.raises(ZeroDivisionError):
            reached_levels.add(stepped, archive, one, 10.0, NOW, "w1")
    assert (len(defined(stepped)), recordings(stepped), due(stepped)) == (2, [], one)
    assert sorted(archive.store.names()) == before
    assert reached_levels.add(stepped, archive, one, 10.0, NOW, "w1") is not None


def _fails(*_: object, **__: object) -> None:
    raise ZeroDivisionError


KILLED = """
import os, signal, sys
from datetime import UTC, datetime
from pathlib import Path
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.recording import reached_levels
catalogue, archive = Catalogue(sys.argv[1]), Archive(FolderStore(Path(sys.argv[2])))
locks.release = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
with catalogue.reading() as session:
    (one,) = reached_levels.due(session)
reached_levels.add(catalogue, archive, one, 10.0, datetime.now(UTC), "w1")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_who_is_killed_before_the_end_leaves_nothing_and_the_next_adds_it(
    stepped: Catalogue, archive: Archive, deployment: Deployment
) -> None:
    url = stepped.engine.url.render_as_string(hide_password=False)
    command = [sys.executable, "-c", KILLED, url, str(deployment.home / "archive")]
    done = subprocess.run(command, env=os.environ, capture_output=True, text=True, check=False)
    assert done.returncode == -9, done.stderr
    # Its last statement was the last of the transaction: nothing of that is there.
    assert (len(defined(stepped)), recordings(stepped)) == (2, [])
    added = add(stepped, archive, 10.0)
    assert added is not None
    assert (added.label, recordings(stepped)) == ("S02", ["plate/S02"])


def test_the_rig_is_free_for_the_recording(stepped: Catalogue, archive: Archive) -> None:
    one = due(stepped)
    assert one is not None
    with stepped.writing() as session:
        watched_rigs.hold(session, one.rig, "w1", NOW, NOW - NOW.replace(hour=0))
    assert reached_levels.add(stepped, archive, one, 10.0, NOW, "w1") is not None
    with stepped.reading() as session:
        assert locks.held_devices(session, NOW) == []


@pytest.mark.parametrize(
    ("read", "last"),
    [(None, None), (10_150.0, 10.0), (-190.0, 0.0), (10_201.0, None), (15_000.0, None)],
)
def test_what_was_recorded_before_the_plan_is_the_last_level(
    catalogue: Catalogue, archive: Archive, read: float | None, last: float | None
) -> None:
    plan(catalogue)
    assert (due(catalogue) or _nothing()).last is None
    measured(catalogue, "S00", 40_000.0)
    measured(catalogue, "S01", read)
    plan(catalogue)
    assert (due(catalogue) or _nothing()).last == last
    told = shown(catalogue)[-1].waits_for
    assert ("but not" in told) is (last is not None)


def _nothing() -> DueLevels:
    raise AssertionError("no levels are due")


def test_a_drift_while_it_is_recorded_is_no_other_level(stepped: Catalogue, archive: Archive) -> None:
    assert add(stepped, archive, 10.0) is not None
    end(stepped, "S02", 9_700.0)  # the specimen has relaxed
    assert (due(stepped) or _nothing()).last == 10.0
    assert "read 9.7" not in (shown(stepped)[0].note or "")  # nobody has said what it read before and after
    # What is recorded beside the plan tells where the test is.
    measured(stepped, "S00", 0.0)
    assert (due(stepped) or _nothing()).last == 0.0


def test_what_breaks_off_waits_for_an_operator_and_is_not_added_again(
    stepped: Catalogue, archive: Archive
) -> None:
    assert add(stepped, archive, 10.0) is not None
    end(stepped, "S02", None, JobState.NEEDS_OPERATOR)
    assert due(stepped) is None
    assert "needs an operator" in shown(stepped)[0].waits_for
    with stepped.writing() as session:
        assert planned_recordings.skip(session, "plate", []) == ["S02"]
        with pytest.raises(NotFound, match="nothing is left to skip in the plan of plate, whose next state"):
            planned_recordings.skip(session, "plate", [])
    assert (due(stepped) or _nothing()).last == 10.0


def test_a_plan_that_is_changed_knows_its_last_level_while_levels_stay(
    stepped: Catalogue, archive: Archive
) -> None:
    assert add(stepped, archive, 10.0) is not None
    end(stepped, "S02", None)
    plan(stepped, replace(LEVELS, for_s=60.0, tolerance=0.1))
    assert (due(stepped) or _nothing()).last == 10.0
    plan(stepped, replace(LEVELS, step=5.0))
    assert (due(stepped) or _nothing()).last is None


def test_a_limit_holds_the_levels_too(catalogue: Catalogue, archive: Archive) -> None:
    plan(catalogue, look=Look(True, (LIMIT,)))
    assert add(catalogue, archive, 10.0) is not None
    end(catalogue, "S02", 10_000.0)
    assert due(catalogue) is None
    assert shown(catalogue)[-1].waits_for.startswith("waits for the quick look at S02")
    with catalogue.writing() as session:
        session.execute(update(JobRow).where(JobRow.kind == "quick-look").values(state=JobState.FAILED))
    quick_looks.judge(catalogue, NOW)
    assert due(catalogue) is None
    assert shown(catalogue)[-1].status == "held"
    assert "it is held back: " in shown(catalogue)[-1].waits_for
    with catalogue.writing() as session:
        assert planned_recordings.set_held(session, "plate", [], False) == ["S03"]
    assert due(catalogue) is not None


def test_a_plan_of_levels_alone_is_shown_and_dropped(stepped: Catalogue) -> None:
    with stepped.reading() as session:
        assert planned_recordings.anything_open(session)
        (one,) = shown_plans.list_planned(session, NOW)
    assert (one.campaign, one.state, one.status, one.is_next) == ("plate", "S02", "planned", True)
    assert one.waits_for.startswith("waits for load_n = any multiple of 10 +- 0.2 kN for 5 s; no worker")
    with stepped.writing() as session:
        planned_levels.note_reading(session, campaigns.campaign_id(session, "plate"), 8.25, NOW)
    (one,) = shown(stepped)
    assert one.waits_for.replace("; it read 8.25 last", "") == one.unless_read
    with stepped.writing() as session:
        for change in (planned_recordings.skip, planned_recordings.drop):
            with pytest.raises(NotFound, match="S02 of plate is not there before its load is held: name no"):
                change(session, "plate", ["S02"])
        assert planned_recordings.drop(session, "plate", []).forgotten == ("S02",)
        assert not planned_recordings.anything_open(session)
        with pytest.raises(NotFound, match="nothing is planned of plate"):
            planned_recordings.drop(session, "plate", [])


def test_a_catalogue_from_the_archive_has_the_states_and_no_plan(
    stepped: Catalogue, archive: Archive
) -> None:
    assert add(stepped, archive, 10.0) is not None
    before = defined(stepped)
    with stepped.writing() as session:
        session.execute(update(PlannedLevelsRow).values(last_state_id=None))
    emptied(stepped)
    paths = reindexing.unknown_files(stepped, archive)
    assert {one.outcome for one in reindexing.reindex(stepped, archive, paths)} == {"indexed"}
    assert defined(stepped) == before
    assert (shown(stepped), due(stepped)) == ([], None)
