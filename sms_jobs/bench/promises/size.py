"""What it costs to ask how things stand where very many jobs have not ended."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from sms_jobs import bootstrap
from sms_jobs.app.work import queues
from sms_jobs.bench.figures import Condition, Figure, Found, Run
from sms_jobs.bench.large.many_jobs import fill_queue
from sms_jobs.bench.promises import Promise
from sms_jobs.bench.servers import POSTGRESQL, environment, fresh_postgresql
from sms_jobs.errors import SmsError
from sms_jobs.records.job import JobState

_ACTIVE = 100_000
_QUICK = 5_000
_REPEATS = 3
_CPU_LIMIT_S = 1.0
_SETTLED_S, _WATCHED_S = 10.0, 30.0
_SHARE_LIMIT = 0.05


def status_cpu_s(home: Path, active: int, run: Run) -> float:
    """Fill a home with active jobs; return the CPU-seconds of a whole `sms status`, user and system."""
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        fill_queue(services.catalogue, active, datetime.now(UTC), run.say)
    taken = []
    for _ in range(_REPEATS):
        status, seconds = _status(home)
        states = (JobState.QUEUED, JobState.WAITING)
        if sum(status["jobs"].get(state.value, 0) for state in states) != active:
            raise SmsError(f"'sms status' reports {status['jobs']} and not {active} active jobs; report it")
        taken.append(seconds)
    return median(taken)


def _status(home: Path) -> tuple[dict[str, Any], float]:
    command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "status", "--json", "--home", str(home)]
    before = os.times()
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    after = os.times()
    seconds = after.children_user + after.children_system - before.children_user - before.children_system
    status: dict[str, Any] = json.loads(done.stdout)
    return status, seconds


def supervisor_share(home: Path) -> float:
    """Return the part of a core that a supervisor needs while all jobs of a home are held back."""
    with bootstrap.services(home) as services:
        queues.pause(services, [], "measuring")
    command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "up", "--home", str(home)]
    with (home / "up.log").open("ab") as log:
        service = psutil.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        time.sleep(_SETTLED_S)
        before = service.cpu_times()
        time.sleep(_WATCHED_S)
        after = service.cpu_times()
    finally:
        service.terminate()
        service.wait(timeout=60)
    return float(after.user + after.system - before.user - before.system) / _WATCHED_S


def measure(run: Run) -> Iterator[Found]:
    """Yield the CPU-seconds of `sms status` on both databases, as far as they are there."""
    active = _QUICK if run.quick else _ACTIVE
    text = (
        f"{active} jobs that have not ended, 4000 a campaign, and 2000 that have; CPU-seconds of the whole "
        f"process 'sms status', loading included, the median of {_REPEATS}"
    )
    run.say("promises: status of very many jobs on SQLite")
    embedded = status_cpu_s(run.folder / "size-embedded", active, run)
    yield Figure("status_100k_cpu_s", None if run.quick else embedded, "s", _CPU_LIMIT_S, "at most")
    yield Condition("status_100k_cpu_s", f"{text}; SQLite")
    run.say("promises: a supervisor of very many jobs")
    share = supervisor_share(run.folder / "size-embedded")
    yield Figure("supervisor_100k_share", None if run.quick else share, "of a core", _SHARE_LIMIT, "at most")
    yield Condition(
        "supervisor_100k_share",
        f"CPU time of the supervisor of the same jobs, all held back, over {_WATCHED_S:g} s; SQLite",
    )
    with fresh_postgresql() as database:
        grown = None
        if database is not None:
            run.say("promises: status of very many jobs on PostgreSQL")
            with environment({"SMS_DATABASE_URL": database}):
                grown = status_cpu_s(run.folder / "size-grown", active, run)
    yield Figure("status_100k_postgresql_cpu_s", None if run.quick else grown, "s", _CPU_LIMIT_S, "at most")
    there = f"{text}; PostgreSQL, whose own is not counted"
    absent = f"left out: {POSTGRESQL} names no server"
    yield Condition("status_100k_postgresql_cpu_s", absent if grown is None else there)


PROMISE = Promise("size", measure)
