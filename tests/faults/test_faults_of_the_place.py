"""What is the fault of disk, share, database or network ends no job: work waits, and goes on by itself."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import make_url, select
from support.archives import Clock, registered, runner
from support.people import SOMEBODY
from support.places import SmallDisk, Wire, mounted
from support.servers import PostgresqlServer

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.asking import explanation
from sms_jobs.jobs.keeping import verification
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.running import recovery
from sms_jobs.records.job import JobState
from sms_jobs.settings import Settings
from sms_jobs.workers.archive_watch import ArchiveWatch

KINDS = ("simulate", "reconstruct")


def with_a_campaign(catalogue: Catalogue, archive: Archive) -> None:
    """Fill a new catalogue with a campaign, a worker `w1`, and jobs that need each other."""
    clock = Clock()
    schema.upgrade(catalogue)
    registered(catalogue, archive, clock)
    with catalogue.writing() as session:
        recovery.register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 1, clock())


def submit_jobs(catalogue: Catalogue, *kinds: str) -> None:
    with catalogue.writing() as session:
        submit(session, "plate", [Request(kind) for kind in kinds], Clock()(), Terms(use_cache=False))


def jobs(catalogue: Catalogue) -> list[JobRow]:
    with catalogue.reading() as session:
        return list(session.scalars(select(JobRow)))


def held_for(catalogue: Catalogue) -> str | None:
    with catalogue.reading() as session:
        return session.get_one(WorkerRow, "w1").held_for


def assert_all_done_once(catalogue: Catalogue, archive: Archive) -> None:
    """Every job has succeeded, once and at no cost, and the archive holds what the catalogue knows."""
    for job in jobs(catalogue):
        assert (job.state, job.crashes, job.tries) == (JobState.SUCCEEDED, 0, 0), job.message
    with catalogue.reading() as session:
        ended = session.scalars(select(EventRow.job_id).where(EventRow.state == JobState.SUCCEEDED)).all()
    assert len(ended) == len(set(ended)) == len(jobs(catalogue))
    assert list(verification.check_unknown(catalogue, archive)) == []


@pytest.fixture
def embedded(home: Path) -> Iterator[Catalogue]:
    """An empty SQLite catalogue, not on the disk that fails."""
    with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}", create=True)) as catalogue:
        yield catalogue


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    """A file system that can be made read-only."""
    with mounted(tmp_path / "disk") as one:
        yield one


def watch(home: Path, catalogue: Catalogue, archive: Archive) -> ArchiveWatch:
    return ArchiveWatch(Services(Settings(home=home, least_room_mb=0.0), catalogue, archive, SOMEBODY), "w1")


def test_a_read_only_archive_begins_no_job(home: Path, embedded: Catalogue, disk: SmallDisk) -> None:
    archive = Archive(FolderStore(disk.folder / "archive"))
    with_a_campaign(embedded, archive)
    submit_jobs(embedded, *KINDS)
    before = {job.id: job.attempts for job in jobs(embedded)}
    assert disk.remount("ro")
    runner(embedded, archive, Clock()).run_queued()
    assert {job.id: job.attempts for job in jobs(embedded)} == before
    reason = held_for(embedded)
    assert reason is not None
    assert "Read-only file system" in reason
    with embedded.reading() as session:
        job = session.scalars(select(JobRow).where(JobRow.state == JobState.QUEUED)).first()
        assert job is not None
        why = explanation.explain(session, job, job.submitted_at)
    assert f"worker w1 claims no job: {reason}; it goes on by itself" in why
    watch(home, embedded, archive).look()
    assert held_for(embedded) == reason
    assert disk.remount("rw")
    watch(home, embedded, archive).look()
    assert held_for(embedded) is None
    runner(embedded, archive, Clock()).run_queued()
    assert_all_done_once(embedded, archive)


def test_a_job_that_meets_a_read_only_folder_waits_for_it_at_no_cost(
    home: Path, embedded: Catalogue, disk: SmallDisk
) -> None:
    # The root can be written to, so that jobs begin, and find out by themselves.
    archive = Archive(FolderStore(disk.folder / "archive"))
    with_a_campaign(embedded, archive)
    submit_jobs(embedded, *KINDS)
    folder = archive.store.root / "plate"
    subprocess.run(["mount", "--bind", folder, folder], check=True)
    subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True)
    try:
        for _ in range(5):  # more often than a job is tried, and than it may crash
            runner(embedded, archive, Clock()).run_queued()
            assert "plate (Read-only file system)" in str(held_for(embedded))
            watch(home, embedded, archive).look()
            assert held_for(embedded) is not None
            with embedded.writing() as session:
                recovery.release(session, "w1")
        assert {job.state for job in jobs(embedded)} == {JobState.QUEUED, JobState.WAITING}
    finally:
        subprocess.run(["umount", folder], check=True)
    runner(embedded, archive, Clock()).run_queued()
    assert_all_done_once(embedded, archive)


def test_an_outage_of_the_database_at_any_commit_ends_no_job(server: PostgresqlServer, home: Path) -> None:
    port = make_url(server.url).port
    assert port is not None
    wire = Wire(port)
    archive = Archive(FolderStore(home / "archive"))
    with (
        closing(wire),
        closing(Catalogue(server.url)) as catalogue,
        closing(Catalogue(server.url.replace(f":{port}/", f":{wire.port}/"))) as over_wire,
    ):
        with_a_campaign(catalogue, archive)
        working = runner(over_wire, archive, Clock())
        # The first commits of a process: claim, beginning, progress, and the end with the next claim.
        for arrives in (True, False):
            for number in range(1, 5):
                submit_jobs(catalogue, "simulate")
                wire.cut(number, arrives=arrives)
                working.run_queued()
                working.run_queued()  # it is woken again when it could not claim
        assert wire.cuts == 8
        assert_all_done_once(catalogue, archive)


def restarted(server: PostgresqlServer, times: int, stop: threading.Event) -> None:
    for _ in range(times):
        server.crash()
        server.start()
        if stop.is_set():
            return


@pytest.mark.parametrize("times", [3, pytest.param(50, marks=pytest.mark.long)])
def test_restarts_of_the_database_end_no_job(server: PostgresqlServer, home: Path, times: int) -> None:
    archive = Archive(FolderStore(home / "archive"))
    with closing(Catalogue(server.url)) as catalogue:
        with_a_campaign(catalogue, archive)
        submit_jobs(catalogue, *KINDS)
    with closing(Catalogue(server.url)) as working:
        stop = threading.Event()
        thread = threading.Thread(target=restarted, args=(server, times, stop))
        thread.start()
        try:
            while thread.is_alive():
                runner(working, archive, Clock()).run_queued()
        finally:
            stop.set()
            thread.join()
        for _ in range(2):  # it is woken again when it could not claim
            runner(working, archive, Clock()).run_queued()
    # By a connection that is newer than the last restart: one that lay idle for a moment is trusted.
    with closing(Catalogue(server.url)) as catalogue:
        assert_all_done_once(catalogue, archive)


@pytest.mark.postgresql
def test_a_network_that_died_under_a_connection_is_noticed(fresh_postgresql_url: str) -> None:
    with closing(Catalogue(fresh_postgresql_url)) as catalogue, catalogue.reading() as session:
        connection = session.connection().connection.dbapi_connection
        assert connection is not None
        with socket.socket(fileno=os.dup(connection.fileno())) as ours:
            assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
            asked = [
                ours.getsockopt(socket.IPPROTO_TCP, option)
                for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
            ]
            assert asked[0] + asked[1] * asked[2] <= 30
            assert 0 < ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) <= 30_000
        assert session.connection().exec_driver_sql("SHOW tcp_keepalives_idle").scalar() == "10"
