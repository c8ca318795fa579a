"""What `sms doctor` notices, and that it says what to do."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NoReturn

import psutil
import pytest
import redis
from pydantic import SecretStr
from sqlalchemy import update
from support.command import kill_all, sms, wait_until
from support.examining import doctor
from support.jobs import JOBS, NOW, claim, submit_pipeline
from support.missing import do_without
from support.places import mounted
from support.servers import RedisServer

from sms_jobs import bootstrap
from sms_jobs.app.home.doctor import Examined, examine
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.monitoring import health
from sms_jobs.jobs.running import lifecycle, liveness, queues, recovery
from sms_jobs.jobs.running.origin import Origin, started_at
from sms_jobs.records.job import JobState
from sms_jobs.settings import Settings
from sms_jobs.workers import broker

HOST = socket.gethostname()


@pytest.fixture
def catalogue(home: Path) -> Iterator[Catalogue]:
    """A catalogue with one worker, which beat at NOW, and no job."""
    with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}", create=True)) as opened:
        schema.upgrade(opened)
        with opened.writing() as session:
            recovery.register_worker(session, "w1", "here", 1, ["cpu", "acquisition"], 2, NOW)
        yield opened


def of_workers(catalogue: Catalogue, after: timedelta) -> list[str]:
    with catalogue.reading() as session:
        return liveness.workers(session, NOW + after)


def test_a_worker_is_missed_until_it_ends_in_order_or_is_replaced(catalogue: Catalogue) -> None:
    def missed(after: timedelta) -> bool:
        return any("w1 on here gave its last sign" in finding for finding in of_workers(catalogue, after))

    assert of_workers(catalogue, timedelta(seconds=60)) == []
    assert missed(timedelta(seconds=61))
    assert not missed(timedelta(days=2))
    with catalogue.writing() as session:
        at = NOW + timedelta(minutes=5)
        recovery.register_worker(session, "w2", "here", 1, ["cpu"], 2, at)
        recovery.beat(session, "w2", NOW + timedelta(hours=1), 2)
    assert of_workers(catalogue, timedelta(hours=1)) == []
    with catalogue.writing() as session:
        session.execute(update(WorkerRow).values(draining=True))
    assert not missed(timedelta(hours=2))


def test_a_worker_without_processes_is_a_finding_once_it_had_time_to_start(catalogue: Catalogue) -> None:
    for after, processes, found in ((30, 0, False), (61, 0, True), (61, 1, False)):
        at = NOW + timedelta(seconds=after)
        with catalogue.writing() as session:
            recovery.beat(session, "w1", at, processes)
        said = of_workers(catalogue, timedelta(seconds=after))
        assert bool(said) is found
        assert not said or "none of its 2 processes" in said[0]


def test_one_is_not_told_as_many(catalogue: Catalogue) -> None:
    (_, *others) = submit_pipeline(catalogue)
    with catalogue.writing() as session:
        for other in others:
            lifecycle.change(session, other, JobState.CANCELLED, NOW, "not wanted")
        for name in queues.queue_names(session):
            queues.pause(session, name, "the rig needs the machine", NOW)
        session.execute(update(WorkerRow).values(concurrency=1))
        recovery.beat(session, "w1", NOW + timedelta(seconds=61), 0)
    (without,) = of_workers(catalogue, timedelta(seconds=61))
    assert "has no process: each ends as soon as it begins" in without
    (none, _) = of_workers(catalogue, timedelta(minutes=4))
    assert none.startswith("no worker is alive: 1 job waits for one; start")
    with catalogue.reading() as session:
        (paused,) = health.pauses(session)
        assert " with 1 job in it: " in paused


def test_that_nobody_is_there_is_a_finding_whether_or_not_there_are_jobs(catalogue: Catalogue) -> None:
    (none, _) = of_workers(catalogue, timedelta(minutes=2))
    assert none.startswith("no worker is alive: 0 jobs wait for one; start the service with 'sms up'")
    submit_pipeline(catalogue)
    assert of_workers(catalogue, timedelta(0)) == []
    claim(catalogue)
    claim(catalogue)
    (none, _) = of_workers(catalogue, timedelta(minutes=2))
    assert f"{JOBS} jobs wait for one, and 2 count as running" in none
    with catalogue.writing() as session:
        recovery.drain(session, "w1")
    assert "is draining" in of_workers(catalogue, timedelta(0))[0]


def test_a_worker_that_takes_nothing_beside_jobs_is_noticed(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)

    def beaten(after: timedelta) -> list[str]:
        with catalogue.writing() as session:
            recovery.beat(session, "w1", NOW + after, 2)
        return of_workers(catalogue, after)

    # It loads for a while, and then a job has waited for long enough, within a minute.
    assert beaten(timedelta(seconds=30)) == []
    (idle,) = beaten(timedelta(seconds=46))
    assert "w1 on here runs 0 of 2 jobs and has not taken the next" in idle
    assert claim(catalogue, NOW + timedelta(seconds=46)) is not None
    assert beaten(timedelta(seconds=60)) == []
    assert "runs 1 of 2" in beaten(timedelta(seconds=90))[0]
    assert claim(catalogue, NOW + timedelta(seconds=90)) is not None
    assert beaten(timedelta(hours=1)) == []


def test_a_worker_that_is_held_says_why(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        recovery.hold(session, "w1", "the archive cannot be used", None)
    assert of_workers(catalogue, timedelta(0)) == [
        "worker w1 on here claims no job: the archive cannot be used; it goes on by itself"
    ]


def test_a_queue_that_nobody_serves_is_noticed(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)

    def found(after: timedelta = timedelta(0)) -> list[str]:
        with catalogue.reading() as session:
            return liveness.unserved(session, NOW + after)

    assert found() == []
    with catalogue.writing() as session:
        session.execute(update(WorkerRow).values(queues="cpu,io"))
    (only,) = found()
    assert "serves the queue 'acquisition'" in only
    assert "sms worker start --queues acquisition" in only
    assert found(timedelta(minutes=2)) == []  # that nobody is there at all is said elsewhere


@pytest.fixture
def family(catalogue: Catalogue) -> Iterator[tuple[psutil.Process, psutil.Process]]:
    """A process with one below it, which the catalogue takes for that of worker `w2` of this host."""
    below = "import subprocess, sys; subprocess.run(['sleep', '600'])"
    with subprocess.Popen([sys.executable, "-c", below]) as process:
        try:
            supervisor = psutil.Process(process.pid)
            (child,) = wait_until(supervisor.children)
            with catalogue.writing() as session:
                now = datetime.now(UTC)
                origin = replace(Origin.own(), started=started_at(process.pid) or 0)
                recovery.register_worker(session, "w2", HOST, process.pid, ["cpu"], 1, now, origin=origin)
            yield supervisor, child
        finally:
            kill_all(psutil.Process(process.pid))


def of_processes(catalogue: Catalogue) -> list[str]:
    with catalogue.reading() as session:
        return liveness.processes(session, datetime.now(UTC), Origin.own())


def test_a_process_that_was_stopped_is_noticed_and_named_with_its_job(
    catalogue: Catalogue, family: tuple[psutil.Process, psutil.Process]
) -> None:
    supervisor, child = family
    assert of_processes(catalogue) == []
    for stopped, what in ((supervisor, "the supervisor of worker w2"), (child, "a process of worker w2")):
        stopped.suspend()
        wait_until(lambda one=stopped: one.status() == psutil.STATUS_STOPPED)
        (finding,) = of_processes(catalogue)
        assert finding.startswith(f"{what}, process {stopped.pid}, which is stopped")
        assert f"kill -CONT {stopped.pid}" in finding
        stopped.resume()
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        held = lifecycle.claim(session, ["acquisition"], "w2", child.pid, datetime.now(UTC))
    assert held is not None
    child.suspend()
    wait_until(lambda: child.status() == psutil.STATUS_STOPPED)
    (finding,) = of_processes(catalogue)
    assert finding.startswith(
        f"job {held.job_id[:8]} ({held.kind} {held.subject}) runs in process {child.pid}"
    )
    child.resume()


def test_another_host_of_the_same_name_is_noticed(catalogue: Catalogue) -> None:
    def of_hosts() -> list[str]:
        with catalogue.reading() as session:
            return liveness.hosts(session, datetime.now(UTC))

    here = Origin("machine", "boot", "namespace", 1)
    # A clone has the machine's id, and a container in it the boot.
    others = {"w3": here, "w4": replace(here, boot="later"), "w5": replace(here, pid_namespace="container")}
    found = []
    for name, origin in others.items():
        with catalogue.writing() as session:
            recovery.register_worker(session, name, HOST, 1, ["cpu"], 1, datetime.now(UTC), origin=origin)
        found.append(of_hosts())
    assert [len(findings) for findings in found] == [0, 1, 3]
    assert found[1][0].startswith(f"workers w3 and w4 both say that they are on '{HOST}'")
    assert "hostnamectl" in found[1][0]


def test_a_pause_is_a_finding_when_it_holds_jobs_back(catalogue: Catalogue) -> None:
    def found() -> list[str]:
        with catalogue.reading() as session:
            return health.pauses(session)

    with catalogue.writing() as session:
        queues.pause(session, "acquisition", "the rig is being moved", NOW)
    assert found() == []
    submit_pipeline(catalogue)
    assert "the rig is being moved; 'sms queue resume acquisition'" in found()[0]
    with catalogue.writing() as session:
        queues.resume(session, "acquisition")
        queues.pause(session, "cpu", "the disk is full", NOW, for_room=True)
    assert "goes on by itself" in found()[0]


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
    root = FolderStore(home / "archive").root
    assert health.archive_works(root) is None
    assert health.other_file_systems(root) is None
    assert list(root.iterdir()) == []
    root.rmdir()
    assert "cannot be used" in str(health.archive_works(root))


def test_an_archive_that_lost_its_disk_is_noticed(catalogue: Catalogue, home: Path) -> None:
    archive = Archive(FolderStore(home / "archive"))

    def found() -> str | None:
        with catalogue.reading() as session:
            return health.files_nobody_knows(session, archive)

    assert found() is None
    submit_pipeline(catalogue)  # it knows a calibration, which nobody has sealed
    assert "mount its disk" in str(found())


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


def test_a_full_redis_is_noticed(home: Path, tmp_path: Path) -> None:
    if shutil.which("redis-server") is None:
        do_without("needs Redis to start a server of its own: install it, or run ops/test.sh")
    server = RedisServer(tmp_path / "redis")
    try:
        settings = Settings(home=home, broker_url=SecretStr(server.url))
        with redis.Redis.from_url(server.url) as client:
            assert broker.examine(settings)[1] is None
            assert client.keys() == []
            client.config_set("maxmemory", "1mb")
            finding = broker.examine(settings)[1]
    finally:
        server.kill()
    assert finding is not None
    assert "Redis takes no messages" in finding
    assert "raise 'maxmemory'" in finding


def test_the_command_tells_what_it_found(home: Path) -> None:
    bootstrap.initialise(home)
    with (
        closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")) as catalogue,
        catalogue.writing() as session,
    ):
        recovery.register_worker(session, "w1", HOST, os.getpid(), ["cpu"], 1, datetime.now(UTC))
    done = sms("doctor", "--json", "--home", str(home))
    checks = {check["check"]: check for check in json.loads(done.stdout)["checks"]}
    # Whether there is room is up to the machine.
    assert [c for name, c in checks.items() if c["finding"] != "ok" and name != "disk"] == []
    assert {"versions", "clock", "messages", "archive", "disk", "queues", "workers"} <= checks.keys()
    for name in ("Python", "HDF5", "SQLite"):
        assert name in checks["versions"]["found"]
    with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")) as catalogue:
        with catalogue.writing() as session:
            queues.pause(session, "cpu", "the disk is full", datetime.now(UTC), for_room=True)
        code, found = doctor(home)
    assert code == 6
    assert "the queue 'cpu' is paused" in found["queues"]


def break_settings(home: Path) -> None:
    (home / "sms.toml").write_text("workers = 'many'")


def break_messages(home: Path) -> None:
    shutil.rmtree(home / "messages", ignore_errors=True)
    (home / "messages").write_text("no folder")


def break_archive(home: Path) -> None:
    (home / "archive").rmdir()
    (home / "archive").write_text("no folder")


def break_tables(home: Path) -> None:
    with closing(sqlite3.connect(home / "catalogue.sqlite")) as connection:
        connection.execute("DROP TABLE worker")


@pytest.mark.parametrize(
    "harm",
    [break_settings, break_messages, break_archive, break_tables, shutil.rmtree],
    ids=lambda h: h.__name__,
)
def test_whatever_is_broken_is_a_finding(home: Path, harm: Callable[[Path], None]) -> None:
    bootstrap.initialise(home)
    harm(home)
    code, found = doctor(home)
    assert code == 6
    assert all(text for text in found.values())


def test_an_examination_that_fails_or_hangs_keeps_nothing_from_being_told() -> None:
    never = threading.Event()

    def fails() -> NoReturn:
        raise RuntimeError("so it is")

    def hangs() -> NoReturn:
        never.wait()
        raise AssertionError

    examinations = {"fails": fails, "hangs": hangs, "ends": Examined}
    found = examine(examinations, patience_s=0.2)
    never.set()
    assert "RuntimeError: so it is" in found["fails"].findings[0]
    assert "gave no answer within 0.2 s" in found["hangs"].findings[0]
    assert found["ends"].findings == ()


def test_a_read_only_archive_is_a_finding(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with mounted(tmp_path / "disk") as disk:
        monkeypatch.setenv("SMS_ARCHIVE", str(disk.folder))
        bootstrap.initialise(home)
        assert disk.remount("ro")
        code, found = doctor(home)
    assert code == 6
    assert "Read-only file system" in found["archive"]
