"""Nobody holds SQLite's only write lock while he computes, and everybody comes to his turn."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import text
from support.homes import make_home
from support.jobs import NOW, REQUESTS, submit_pipeline

from sms_jobs import bootstrap
from sms_jobs.bench.promises.submits import submissions
from sms_jobs.catalogue import database
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import CatalogueBusy
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning.turns import planning_turn
from sms_jobs.jobs.scheduling import firing, schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression
from sms_jobs.jobs.scheduling.schedules import Order

LISTEN = """
import json, runpy, sys
from sqlalchemy import event
from sqlalchemy.pool import Pool

begun = []

def traced(statement):
    if statement.startswith("BEGIN IMMEDIATE"):
        begun.append("numba" in sys.modules)

event.listen(Pool, "connect", lambda connection, record: connection.set_trace_callback(traced))
told = []
for further in ("--dry-run", "--priority=0"):
    begun.clear()
    sys.argv = ["sms", "job", "submit", "simulate", "-c", "plate", "--home", sys.argv[-1]]
    sys.argv.insert(3, further)
    try:
        runpy.run_module("sms_jobs.cli.main", run_name="__main__")
    except SystemExit as end:
        assert not end.code, end.code
    told.append(list(begun))
    sys.modules.pop("sms_jobs.cli.main", None)
print(json.dumps(told))
"""


def test_a_dry_run_writes_nothing_and_kinds_are_loaded_before_the_lock_is_taken(home: Path) -> None:
    make_home(home, {})
    done = subprocess.run(
        [sys.executable, "-c", LISTEN, str(home)], capture_output=True, text=True, check=True
    )
    dry, real = json.loads(done.stdout.splitlines()[-1])
    assert dry == []
    assert real == [True]


def test_a_crowd_that_submits_at_once_is_served(home: Path, tmp_path: Path) -> None:
    visits = submissions(home, 12, tmp_path)
    assert [(v.exit_code, v.said) for v in visits if v.exit_code] == []
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        assert sum(inquiry.counts(session).values()) == 2 * len(visits)


def write(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        session.connection()


@pytest.fixture
def catalogue(home: Path) -> Catalogue:
    make_home(home, {})
    return Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")


def test_a_writer_waits_for_another(catalogue: Catalogue) -> None:
    had = threading.Event()

    def wait() -> None:
        write(catalogue)
        had.set()

    waiting = threading.Thread(target=wait)
    with catalogue.writing() as session:
        session.connection()
        waiting.start()
        assert not had.wait(0.2)
    waiting.join(timeout=60.0)
    assert had.is_set()


def test_one_who_waits_too_long_is_told_to_try_again(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "_PATIENCE_S", 0.1)
    with catalogue.writing() as session:
        session.connection()
        with pytest.raises(CatalogueBusy, match="nothing was changed; try again") as refused:
            write(catalogue)
    assert refused.value.retryable
    assert refused.value.exit_code == 7
    # The connection that was refused reads, and waits as a reader does.
    with catalogue.reading() as session:
        assert session.scalar(text("PRAGMA busy_timeout")) == 30_000
    with catalogue.writing() as session:
        assert session.scalar(text("SELECT 1")) == 1


def test_nothing_is_written_while_no_schedule_is_due(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue, "other")
    every = parse_expression("every 60s", "UTC")
    schedules.add(catalogue, "nightly", every, Order("other", tuple(REQUESTS)), NOW)
    with catalogue.writing() as session:
        session.connection()  # who would write now would wait
        assert firing.fire_due(catalogue, NOW + timedelta(seconds=30)) == []
    assert len(firing.fire_due(catalogue, NOW + timedelta(seconds=61))) == 1


def test_turns_are_had_by_as_many_as_there_are_processors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    had = threading.Event()

    def plan() -> None:
        with planning_turn(tmp_path):
            had.set()

    waiting = threading.Thread(target=plan)
    with planning_turn(tmp_path):
        waiting.start()
        assert not had.wait(0.3)
    waiting.join(timeout=60.0)
    assert had.is_set()
    with planning_turn(tmp_path / "nowhere"):
        pass  # it is a courtesy
