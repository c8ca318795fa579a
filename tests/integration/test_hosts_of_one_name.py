"""Hosts of one name share a campaign: their clocks are hours apart and are set; in the long form they sleep.

Each is a container of its own, with a clock that the test can set: real services, processes and servers.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psutil
import pytest
from sqlalchemy import select
from support.command import SMS, kill_all, wait_until
from support.homes import make_home

from sms_jobs import bootstrap
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.records.job import ACTIVE, JobState

CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

static long ahead(void) {
    static volatile long *seconds;
    if (!seconds) seconds = mmap(0, sizeof(long), PROT_READ, MAP_SHARED, open(getenv("CLOCK"), O_RDONLY), 0);
    return *seconds;
}
int clock_gettime(clockid_t which, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(which, now);
    if (!failed && which == CLOCK_REALTIME) now->tv_sec += ahead();
    return failed;
}
int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec precise;
    clock_gettime(CLOCK_REALTIME, &precise);
    now->tv_sec = precise.tv_sec;
    now->tv_usec = precise.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *kept) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (kept) *kept = now.tv_sec;
    return now.tv_sec;
}
"""
LEASE_S = 6.0
HOUR_S = 3600
PATIENCE_S = 300.0


class Clock:
    """What a host takes for the time: the machine's, and so many seconds more."""

    def __init__(self, file: Path, ahead_s: int) -> None:
        self.file = file
        file.write_bytes(bytes(8))
        self.set(ahead_s)

    def set(self, ahead_s: int) -> None:
        with self.file.open("r+b") as open_file:
            open_file.write(ahead_s.to_bytes(8, "little", signed=True))


@pytest.fixture(scope="module")
def clock_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library that lets a process read another clock."""
    if os.geteuid() != 0 or shutil.which("unshare") is None or shutil.which("cc") is None:
        pytest.skip("needs root, unshare and a C compiler to make hosts with clocks of their own")
    folder = tmp_path_factory.mktemp("clock")
    (folder / "clock.c").write_text(CLOCK)
    made = ["cc", "-shared", "-fPIC", "-o", str(folder / "clock.so"), str(folder / "clock.c"), "-ldl"]
    subprocess.run(made, check=True)
    return folder / "clock.so"


@contextmanager
def host(home: Path, environment: Mapping[str, str]) -> Iterator[psutil.Process]:
    """Serve in a container; give the process that holds it."""
    container = ["unshare", "--uts", "--pid", "--fork", "--kill-child", "--mount-proc"]
    serve = 'hostname rig-pc && exec "$@"'
    with (home / "up.log").open("ab") as log:
        held = subprocess.Popen(
            [*container, "sh", "-c", serve, "sh", *SMS, "up", "--home", str(home)],
            env=os.environ | dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
    process = psutil.Process(held.pid)
    # What has one number and one name began at one time in no two hosts.
    time.sleep(2 / os.sysconf("SC_CLK_TCK"))
    try:
        yield process
        for inside in process.children():
            inside.send_signal(signal.SIGTERM)
        assert held.wait(timeout=120) == 0
    finally:
        if held.poll() is None:
            kill_all(process)
            held.wait()


@pytest.mark.parametrize(
    ("ahead_s", "submissions", "asleep_s"),
    [
        pytest.param((0, 24 * HOUR_S), 6, 0.0, id="two"),
        pytest.param((0, HOUR_S, -HOUR_S, 24 * HOUR_S), 20, 2 * LEASE_S, marks=pytest.mark.long, id="four"),
    ],
)
def test_hosts_of_one_name_interrupt_nothing(
    fresh_postgresql_url: str,
    redis_url: str,
    tmp_path: Path,
    clock_library: Path,
    monkeypatch: pytest.MonkeyPatch,
    ahead_s: tuple[int, ...],
    submissions: int,
    asleep_s: float,
) -> None:
    environment = {
        "SMS_DATABASE_URL": fresh_postgresql_url,
        "SMS_BROKER_URL": redis_url,
        "SMS_ARCHIVE": str(tmp_path / "shared"),
        "SMS_WORKERS": "2",
        "SMS_LEASE_S": str(LEASE_S),
    }
    homes = [tmp_path / f"home-{k}" for k in range(len(ahead_s))]
    make_home(homes[0], environment)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    for home in homes[1:]:
        bootstrap.initialise(home)
    clocks = [Clock(tmp_path / f"clock-{k}", seconds) for k, seconds in enumerate(ahead_s)]
    with closing(Catalogue(fresh_postgresql_url)) as catalogue, ExitStack() as at_the_end:
        held = [
            at_the_end.enter_context(
                host(home, environment | {"LD_PRELOAD": str(clock_library), "CLOCK": str(clock.file)})
            )
            for home, clock in zip(homes, clocks, strict=True)
        ]

        def ready() -> bool:
            with catalogue.reading() as session:
                return session.scalars(select(WorkerRow.processes)).all() == [2] * len(homes)

        wait_until(ready, timeout=PATIENCE_S)
        with catalogue.reading() as session:
            workers = session.scalars(select(WorkerRow)).all()
        assert {worker.host for worker in workers} == {"rig-pc"}
        assert {worker.pid for worker in workers} == {1}
        assert max(w.beat_at for w in workers) - min(w.beat_at for w in workers) > timedelta(hours=20)

        with catalogue.writing() as session:
            for _ in range(submissions):
                submit(session, "plate", [Request("simulate")], datetime.now(UTC), Terms(use_cache=False))

        def after(ended: int) -> bool:
            with catalogue.reading() as session:
                states = Counter(session.scalars(select(JobRow.state)))
            return sum(n for state, n in states.items() if state not in ACTIVE) >= ended

        wait_until(lambda: after(submissions // 2), timeout=PATIENCE_S)
        clocks[0].set(HOUR_S)
        clocks[1].set(-HOUR_S)
        wait_until(lambda: after(submissions), timeout=PATIENCE_S)
        if asleep_s:
            # All of them, for longer than a lease.
            asleep = [p for one in held for p in one.children(recursive=True)]
            for process in asleep:
                process.suspend()
            time.sleep(asleep_s)
            for process in asleep:
                process.resume()
        wait_until(lambda: after(2 * submissions), timeout=PATIENCE_S)

        with catalogue.reading() as session:
            jobs = session.scalars(select(JobRow)).all()
            told = Counter(session.scalars(select(EventRow.state)))
        assert {(job.state, job.attempts) for job in jobs} == {(JobState.SUCCEEDED, 1)}
        assert told[JobState.LOST] == told[JobState.QUARANTINED] == 0
        assert {job.worker_id for job in jobs} == {worker.id for worker in workers}
