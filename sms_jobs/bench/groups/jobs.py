"""The job service: what a job costs besides its work, planning ten thousand, and workers that compete."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import func, select

from sms_jobs import bootstrap
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.servers import POSTGRESQL, REDIS, environment, fresh_postgresql
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit, submit_to
from sms_jobs.jobs.running import lifecycle, recovery
from sms_jobs.records.job import ACTIVE, JobState
from sms_jobs.virtual_rig.campaigns import small_plate, top_hat_bending

_WORKERS = 8
_STATES = 500
_RUN = ("S00", "S01")
_PATIENCE_S = 180.0


def _register_long_test(home: Path, deformed: int) -> None:
    calibration, campaign = top_hat_bending("long-test", "small")
    states = tuple(replace(campaign.states[1], label=f"S{n:03d}") for n in range(1, deformed + 1))
    campaign = replace(campaign, states=(campaign.states[0], *states))
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        now = datetime.now(UTC)
        register_campaign(services.catalogue, services.archive, campaign, calibration, now)


def _planned(run: Run) -> Iterator[Found]:
    home = run.folder / "jobs-plan"
    home.mkdir()
    deformed = 52 if run.quick else 529
    run.say("jobs: planning and submitting a campaign")
    _register_long_test(home, deformed)
    with bootstrap.services(home) as services:
        started = time.perf_counter()
        requests = [Request("simulate"), Request("pipeline")]
        done = submit_to(services.catalogue, "long-test", requests, datetime.now(UTC))
        taken = time.perf_counter() - started
        yield Figure("plan_submit_10k_s", None if run.quick else taken, "s", 10.0, "at most")
        yield Condition("plan_submit", f"{len(done.job_ids)} jobs in one transaction on SQLite, once")
        claims = _contended(services.settings.catalogue_url, 100 if run.quick else 500)
    yield Figure("claim_contention_8_workers_per_s", claims, "1 / s")
    yield Condition(
        "claim_contention",
        f"{_WORKERS} workers as threads of one process, each with connections of its own, claim jobs of "
        "the same SQLite catalogue as fast as they can, every claim a transaction that is forced to the disk",
    )


def _contended(url: str, count: int) -> float:
    """Return claims a second of several workers on one catalogue."""
    queues = ["cpu", "io", "acquisition"]
    claimed: list[str] = []
    ready = threading.Barrier(_WORKERS + 1)

    def work(name: str) -> None:
        with closing(Catalogue(url)) as catalogue:
            now = datetime.now(UTC)
            with catalogue.writing() as session:
                recovery.register_worker(session, name, "here", os.getpid(), queues, 1, now)
            ready.wait()
            while len(claimed) < count:
                with catalogue.writing() as session:
                    held = lifecycle.claim(session, queues, name, os.getpid(), now)
                if held is None:
                    return
                claimed.append(held.job_id)

    workers = [threading.Thread(target=work, args=(f"bench{k}",)) for k in range(_WORKERS)]
    for worker in workers:
        worker.start()
    ready.wait()
    started = time.perf_counter()
    for worker in workers:
        worker.join()
    taken = time.perf_counter() - started
    if len(set(claimed)) != len(claimed):
        raise SmsError("a job was claimed twice; this is a defect of the catalogue, report it")
    return len(claimed) / taken


def _overhead_ms(home: Path, submissions: int) -> tuple[float, int]:
    """Return milliseconds a job whose result is reused, and how many there were, through a real worker."""
    home.mkdir()
    bootstrap.initialise(home)
    command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "up", "--home", str(home)]
    with bootstrap.services(home) as services:
        calibration, campaign = small_plate("plate")
        # Two states are run; the others are there because what a service does for a job may grow with them.
        more = (replace(campaign.states[1], label=f"S{n:03d}") for n in range(2, _STATES))
        campaign = replace(campaign, states=(*campaign.states[:2], *more))
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
        with (home / "up.log").open("ab") as log:
            supervisor = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            _submit(services.catalogue, 1)
            _wait(services.catalogue)
            first = datetime.now(UTC)
            _submit(services.catalogue, submissions)
            _wait(services.catalogue)
        finally:
            supervisor.terminate()
            supervisor.wait(timeout=60)
        with services.catalogue.reading() as session:
            times = select(func.min(JobRow.started_at), func.max(JobRow.finished_at), func.count())
            reused = times.where(
                JobRow.submitted_at >= first,
                JobRow.state == JobState.SUCCEEDED,
                JobRow.reused_from.is_not(None),
            )
            began, ended, number = session.execute(reused).one()
    if not number or began is None or ended is None:
        raise SmsError(f"no job was reused; {home / 'up.log'} tells what the worker did")
    return 1e3 * (ended - began).total_seconds() / number, number


def _submit(catalogue: Catalogue, times: int) -> None:
    # All at once, so that the worker never waits for the next.
    with catalogue.writing() as session:
        for _ in range(times):
            submit(session, "plate", [Request("simulate", states=_RUN)], datetime.now(UTC))


def _wait(catalogue: Catalogue) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        with catalogue.reading() as session:
            if not session.scalar(select(func.count()).where(JobRow.state.in_(ACTIVE))):
                return
        time.sleep(0.1)
    raise SmsError(f"the jobs of the benchmark did not end within {_PATIENCE_S:.0f} s; is the machine busy?")


def _overhead(run: Run) -> Iterator[Found]:
    submissions = 25 if run.quick else 250
    text = (
        "{number} jobs whose result is reused, so that all is service and no work, of a campaign of "
        f"{_STATES} states, through one worker process of `sms up`: from the first start to the last end, "
        "claim, context, reuse key, log file and end"
    )
    run.say("jobs: what a job costs on the embedded deployment")
    with environment({"SMS_WORKERS": "1"}):
        taken, number = _overhead_ms(run.folder / "jobs-embedded", submissions)
    yield Figure("overhead_embedded_ms", taken, "ms", 10.0, "at most")
    yield Condition("overhead_embedded", text.format(number=number) + "; SQLite, messages as files")
    broker = os.environ.get(REDIS)
    with fresh_postgresql() as database:
        if database is None or not broker:
            yield Figure("overhead_grown_ms", None, "ms", 3.0, "at most")
            yield Condition("overhead_grown", f"left out: {POSTGRESQL} and {REDIS} name no servers")
            return
        run.say("jobs: what a job costs on PostgreSQL and Redis")
        grown = {"SMS_WORKERS": "1", "SMS_DATABASE_URL": database, "SMS_BROKER_URL": broker}
        with environment(grown):
            taken, number = _overhead_ms(run.folder / "jobs-grown", submissions)
    yield Figure("overhead_grown_ms", taken, "ms", 3.0, "at most")
    yield Condition("overhead_grown", text.format(number=number) + "; PostgreSQL and Redis of this machine")


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    yield from _planned(run)
    yield from _overhead(run)


GROUP = Group("jobs", "what jobs cost besides their work", lambda: None, measure)
