"""What `sms doctor` notices, and that it says what to do."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import redis
from pydantic import SecretStr
from sqlalchemy import update
from support.command import sms
from support.jobs import NOW, claim, submit_pipeline

from sms_jobs import bootstrap
from sms_jobs.archive import Archive
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import WorkerRow
from sms_jobs.jobs import health, queues, recovery
from sms_jobs.settings import Settings
from sms_jobs.workers import broker


@pytest.fixture
def catalogue(home: Path) -> Iterator[Catalogue]:
    """A catalogue with one worker, which beat at NOW, and no job."""
    with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}", create=True)) as opened:
        schema.upgrade(opened)
        with opened.writing() as session:
            recovery.register_worker(session, "w1", "here", 1, ["cpu", "acquisition"], 2, NOW)
        yield opened


def of_workers(catalogue: Catalogue, after: timedelta) -> str | None:
    with catalogue.reading() as session:
        return health.workers(session, NOW + after)


def test_a_worker_is_missed_until_it_ends_in_order_or_is_replaced(catalogue: Catalogue) -> None:
    assert of_workers(catalogue, timedelta(seconds=60)) is None
    missed = of_workers(catalogue, timedelta(seconds=61))
    assert missed is not None
    assert "w1 on here" in missed
    assert "sms up" in missed
    assert of_workers(catalogue, timedelta(days=2)) is None
    with catalogue.writing() as session:
        at = NOW + timedelta(minutes=5)
        recovery.register_worker(session, "w2", "here", 1, ["cpu"], 2, at)
        recovery.beat(session, "w2", NOW + timedelta(hours=1))
    assert of_workers(catalogue, timedelta(hours=1)) is None
    with catalogue.writing() as session:
        session.execute(update(WorkerRow).values(draining=True))
    assert of_workers(catalogue, timedelta(hours=2)) is None


def test_jobs_that_nobody_runs_are_noticed(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    assert of_workers(catalogue, timedelta(0)) is None
    assert "2 jobs are queued" in str(of_workers(catalogue, timedelta(minutes=2)))
    claim(catalogue)
    claim(catalogue)
    assert "2 jobs count as running" in str(of_workers(catalogue, timedelta(minutes=2)))


def test_a_pause_is_a_finding_when_it_holds_jobs_back(catalogue: Catalogue) -> None:
    def found() -> str | None:
        with catalogue.reading() as session:
            return health.pauses(session)

    with catalogue.writing() as session:
        queues.pause(session, "acquisition", "the rig is being moved", NOW)
    assert found() is None
    submit_pipeline(catalogue)
    assert "the rig is being moved; 'sms queue resume acquisition'" in str(found())
    with catalogue.writing() as session:
        queues.resume(session, "acquisition")
        queues.pause(session, "cpu", "the disk is full", NOW, for_room=True)
    assert "goes on by itself" in str(found())


@pytest.mark.parametrize(
    ("ahead_s", "says"), [(2.9, None), (3.1, "3.1 s ahead of"), (-40.0, "40.0 s behind")]
)
def test_a_clock_may_be_a_tenth_of_a_lease_off(ahead_s: float, says: str | None) -> None:
    finding = health.clock_finding(timedelta(seconds=ahead_s), timedelta(seconds=30))
    assert (finding is None) if says is None else says in str(finding)


def test_the_clock_of_a_server_is_compared(fresh_postgresql_url: str) -> None:
    with closing(Catalogue(fresh_postgresql_url)) as catalogue:
        # Server and test have one clock; what is measured is at most half the time of a round trip, and a
        # round trip on loopback stays far below the 2 s that are twice a tenth of this lease.
        assert health.clock(catalogue, timedelta(seconds=10)) is None
        assert health.clock(catalogue, timedelta(0)) is not None
        with catalogue.reading() as session:
            assert health.database_version(session).startswith("PostgreSQL 1")


def test_an_archive_is_written_to_and_left_as_it_was(home: Path) -> None:
    archive = Archive(home / "archive")
    assert health.archive_writes(archive) is None
    assert health.other_file_systems(archive) is None
    assert list(archive.root.iterdir()) == []
    archive.root.rmdir()
    assert "cannot be written to" in str(health.archive_writes(archive))


@pytest.mark.redis
def test_a_broker_that_would_lose_messages_is_noticed(redis_url: str, home: Path) -> None:
    settings = Settings(home=home, broker_url=SecretStr(redis_url))
    what, finding = broker.examine(settings)
    assert (what.startswith("Redis "), finding) == (True, None)
    with redis.Redis.from_url(redis_url) as client:
        try:
            client.config_set("maxmemory-policy", "allkeys-lru")
            assert "noeviction" in str(broker.examine(settings)[1])
        finally:
            client.config_set("maxmemory-policy", "noeviction")
    away = Settings(home=home, broker_url=SecretStr("redis://:open-sesame@127.0.0.1:1/0"))
    finding = broker.examine(away)[1]
    assert finding is not None
    assert "does not answer" in finding
    assert "open-sesame" not in finding


def test_the_command_tells_what_it_found(home: Path) -> None:
    bootstrap.initialise(home)
    done = sms("doctor", "--json", "--home", str(home))
    checks = {check["check"]: check for check in json.loads(done.stdout)["checks"]}
    # Whether there is room is up to the machine.
    assert [c for name, c in checks.items() if c["finding"] != "ok" and name != "disk"] == []
    assert {"versions", "clock", "messages", "archive", "disk", "queues", "workers"} <= checks.keys()
    for name in ("Python", "HDF5", "SQLite"):
        assert name in checks["versions"]["found"]
    with (
        closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")) as catalogue,
        catalogue.writing() as session,
    ):
        queues.pause(session, "cpu", "the disk is full", datetime.now(UTC), for_room=True)
    done = sms("doctor", "--home", str(home))
    assert done.returncode == 6
    assert "the queue 'cpu' is paused" in " ".join(done.stdout.split())
