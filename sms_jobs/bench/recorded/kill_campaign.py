"""A service whose processes are killed and stopped, idle ones and busy ones, and what became of its jobs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import TypeVar

import numpy as np
import psutil
from sqlalchemy import func, select

from sms_jobs import bootstrap
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.records.job import ACTIVE, JobState
from sms_jobs.virtual_rig.campaigns import small_plate

Found = TypeVar("Found")

_PATIENCE_S = 300.0
_WORK = 4
"""Jobs that are submitted at a time."""


class Target(Enum):
    """Which processes are hit."""

    IDLE = "an idle place"
    BUSY = "a busy place"
    ALL = "all places"
    NURSERY = "the nursery"


@dataclass(frozen=True)
class Hit:
    """One fault: whom, and by what signal."""

    target: Target
    number: signal.Signals

    def __str__(self) -> str:
        return f"{self.target.value} {'killed' if self.number is signal.SIGKILL else 'stopped'}"


@dataclass
class Outcome:
    """What came of a campaign.

    Attributes
    ----------
    jobs
        How many there were.
    kills, stops
        Processes that were ended, and stopped.
    stalls_s
        From each hit to the next beginning of a job.
    lost
        Jobs that have not succeeded, or left no file.
    twice
        Jobs that succeeded twice, or left more than one file.
    idle_end_s
        From SIGTERM to the end of the service, when nothing was left to do.
    """

    jobs: int = 0
    kills: int = 0
    stops: int = 0
    stalls_s: list[float] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    twice: list[str] = field(default_factory=list)
    idle_end_s: float = 0.0


def plan(kills: int, stops: int, rng: np.random.Generator) -> list[Hit]:
    """Return hits in a random order: mostly idle and busy places, now and then all of them or the nursery."""
    hits = []
    for number, count in ((signal.SIGKILL, kills), (signal.SIGSTOP, stops)):
        turns = [Target.IDLE, Target.BUSY, Target.ALL, Target.IDLE, Target.BUSY, Target.NURSERY]
        turns += [Target.IDLE, Target.BUSY] * 3
        hits += [Hit(turns[k % len(turns)], number) for k in range(count)]
    return [hits[k] for k in rng.permutation(len(hits))]


class KillCampaign:
    """A service in a home of its own.

    Parameters
    ----------
    home
        An empty folder.
    environment
        Settings of the deployment.
    places
        Processes for jobs.
    rng
        By which victims are drawn.
    """

    def __init__(
        self, home: Path, environment: Mapping[str, str], places: int, rng: np.random.Generator
    ) -> None:
        self._home = home
        # It is the campaign that kills them, not the jobs: none is to be quarantined for it.
        own = {"SMS_WORKERS": str(places), "SMS_CRASH_BUDGET": "100", "SMS_LEAST_ROOM_MB": "2"}
        self._environment = os.environ | dict(environment) | own
        self._places = places
        self._rng = rng
        self._outcome = Outcome()

    def run(self, hits: Sequence[Hit], say: Callable[[str], None]) -> Outcome:
        """Serve, let all hits happen, end in order, and judge."""
        with closing(self._prepared()) as catalogue, self._served() as supervisor:
            self._submit(catalogue)
            for k, hit in enumerate(hits):
                stall_s = self._hit(catalogue, supervisor, hit)
                say(f"{k + 1} of {len(hits)}: {hit}, the next job began after {stall_s:.1f} s")
            self._settle(catalogue)
            began = time.monotonic()
            supervisor.terminate()
            supervisor.wait(_PATIENCE_S)
            self._outcome.idle_end_s = time.monotonic() - began
            self._judge(catalogue)
        return self._outcome

    def _prepared(self) -> Catalogue:
        with _environment(self._environment):
            bootstrap.initialise(self._home)
            with bootstrap.services(self._home) as services:
                calibration, campaign = small_plate("plate")
                # One view, so that each job leaves one file.
                campaign = replace(campaign, views=campaign.views[:1])
                now = datetime.now(UTC)
                register_campaign(services.catalogue, services.archive, campaign, calibration, now)
                return Catalogue(services.settings.catalogue_url)

    @contextmanager
    def _served(self) -> Iterator[psutil.Process]:
        command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "up", "--home", str(self._home)]
        with (self._home / "up.log").open("ab") as log:
            service = subprocess.Popen(
                command, env=self._environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        supervisor = psutil.Process(service.pid)
        try:
            yield supervisor
        finally:
            if service.poll() is None:
                # Places and nursery end with it.
                service.kill()
            service.wait()

    def _submit(self, catalogue: Catalogue) -> None:
        with catalogue.writing() as session:
            for _ in range(_WORK // 2):
                # Whatever was computed before is computed again: of what is reused, nobody can be hit.
                request = Request("simulate")
                done = submit(session, "plate", [request], datetime.now(UTC), Terms(use_cache=False))
                self._outcome.jobs += len(done.job_ids)

    def _hit(self, catalogue: Catalogue, supervisor: psutil.Process, hit: Hit) -> float:
        victims = self._victims(catalogue, supervisor, hit.target)
        known = _last_beginning(catalogue)
        began = time.monotonic()
        for victim in victims:
            with suppress(psutil.NoSuchProcess):
                victim.send_signal(hit.number)
        if hit.number is signal.SIGKILL:
            self._outcome.kills += len(victims)
        else:
            self._outcome.stops += len(victims)
        if hit.target is not Target.BUSY or not _count(catalogue, JobState.QUEUED):
            self._submit(catalogue)
        _wait(lambda: _last_beginning(catalogue) > known, f"no job began after this: {hit}")
        stall_s = time.monotonic() - began
        self._outcome.stalls_s.append(stall_s)
        return stall_s

    def _victims(
        self, catalogue: Catalogue, supervisor: psutil.Process, target: Target
    ) -> list[psutil.Process]:
        def found() -> list[psutil.Process]:
            with suppress(psutil.NoSuchProcess):
                nurseries, there = supervisor.children(), self._there(supervisor)
                busy = _busy(catalogue)
                if target is Target.NURSERY:
                    return nurseries if there else []
                if target is Target.ALL:
                    return there if len(there) == self._places else []
                if target is Target.BUSY and not _count(catalogue, *ACTIVE):
                    self._submit(catalogue)
                some = [p for p in there if (p.pid in busy) is (target is Target.BUSY)]
                return [some[self._rng.integers(len(some))]] if some else []
            return []

        if target is Target.IDLE:
            self._settle(catalogue)
        return _wait(found, f"{target.value} was not met")

    def _there(self, supervisor: psutil.Process) -> list[psutil.Process]:
        """Return the places; those whose nursery was killed are nobody's children any more."""
        nurseries = supervisor.children()
        return [p for p in psutil.process_iter() if p not in nurseries and self._is_of_nursery(p)]

    def _is_of_nursery(self, process: psutil.Process) -> bool:
        with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            # What has died and nobody has buried yet has no command any more.
            if "sms_jobs.workers.nursery" in process.cmdline():
                # What compiles kernels is no place: it is nicer than those.
                same = process.nice() == psutil.Process().nice()
                return same and bool(process.environ().get("SMS_HOME") == str(self._home))
        return False

    def _settle(self, catalogue: Catalogue) -> None:
        _wait(lambda: not _count(catalogue, *ACTIVE), "the jobs did not end")

    def _judge(self, catalogue: Catalogue) -> None:
        succeeded = (
            select(EventRow.job_id, func.count())
            .where(EventRow.state == JobState.SUCCEEDED)
            .group_by(EventRow.job_id)
        )
        files = select(FileRow.job_id, func.count()).group_by(FileRow.job_id)
        with catalogue.reading() as session:
            jobs = session.execute(select(JobRow.id, JobRow.state)).all()
            ends, made = (dict(session.execute(q).all()) for q in (succeeded, files))
        done = {job_id for job_id, state in jobs if state is JobState.SUCCEEDED}
        self._outcome.lost = [i for i, _ in jobs if i not in done or not made.get(i)]
        self._outcome.twice = [i for i, _ in jobs if ends.get(i, 0) > 1 or made.get(i, 0) > 1]
        if len(jobs) != self._outcome.jobs:
            raise SmsError(f"{self._outcome.jobs} jobs were submitted and {len(jobs)} are there; report it")


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _last_beginning(catalogue: Catalogue) -> int:
    query = select(func.max(EventRow.id)).where(EventRow.state == JobState.RUNNING)
    with catalogue.reading() as session:
        return session.scalar(query) or 0


def _count(catalogue: Catalogue, *states: JobState) -> int:
    query = select(func.count()).select_from(JobRow).where(JobRow.state.in_(states))
    with catalogue.reading() as session:
        return session.scalar(query) or 0


def _busy(catalogue: Catalogue) -> set[int | None]:
    with catalogue.reading() as session:
        return set(session.scalars(select(JobRow.pid).where(JobRow.state == JobState.RUNNING)))


def _wait(look: Callable[[], Found], complaint: str) -> Found:
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        found = look()
        if found:
            return found
        time.sleep(0.02)
    raise SmsError(f"{complaint} within {_PATIENCE_S:.0f} s")
