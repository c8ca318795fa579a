"""A test day on a simulated rig: states are recorded as planned, and the service is killed at any moment."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import psutil
from sqlalchemy import func, select

from sms_jobs import bootstrap
from sms_jobs.app.measuring import planned_recordings, recordings
from sms_jobs.app.measuring.planned_recordings import AtLoad
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.errors import ArchiveCorrupt, Conflict, ServerUnreachable, SmsError
from sms_jobs.instruments.kept_sets import finished_sets
from sms_jobs.instruments.spool import Spooled
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.products import INTERRUPTED, MEASURED
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.job import JobState
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.units import typed
from sms_jobs.virtual_rig.campaigns import small_plate

CAMPAIGN = "testday"
SEQUENCE = FringeSequence((8, 7), 3)
TOLERANCE = "20N"
HOLD_S = 0.5
_STEP_N = 100.0
_RAMP_N = 50.0
"""So far the load goes in a tenth of a second."""
_VIEW = "C1P1"
_PATIENCE_S = 120.0
"""For the service to come up, and for something to happen to the plan."""
_AFTER_A_BEGINNING = 0.75
"""How often a kill waits until another recording has started, so that most of them meet one."""
_WITHIN_S = 3.0
_WITHIN_LAST_S = 1.0
"""Less than a recording takes, whose twelve patterns need a tenth of a second each to be on."""
_ANY_TIME_S = 20.0
_RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [{ name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 100.0 }]

[[file_channels]]
name = "load_n"
path = "LOAD"
column = "load"
unit = "N"
stale_after_s = 10.0
"""


@dataclass
class Day:
    """What came of a test day.

    Attributes
    ----------
    states
        How many there were.
    kills
        How many times the service, or processes of it, were killed.
    resumed
        Recordings that broke off and were resumed.
    once
        States with one recording job that has succeeded once, and one measurement.
    doubted
        States of which the plan says that they were not recorded in what was waited for.
    delivered, lost
        Frames that came into the spool, in sets that were finished or broke off, and those of them that are
        not in the archive.
    """

    states: int
    kills: int = 0
    resumed: int = 0
    once: int = 0
    doubted: int = 0
    delivered: int = 0
    lost: int = 0
    broken: dict[Path, int] = field(default_factory=dict)
    """Sets that broke off, as files of the spool, and how many complete frames each had after the kill."""


class KilledPlan:
    """A service in a home of its own, a plan that waits for loads, and whoever kills and resumes.

    Parameters
    ----------
    home
        An empty folder.
    environment
        Settings of the deployment.
    states
        How many are planned.
    rng
        By which moments and victims are drawn.
    """

    def __init__(
        self, home: Path, environment: Mapping[str, str], states: int, rng: np.random.Generator
    ) -> None:
        self._home = home
        own = {"SMS_WORKERS": "1", "SMS_THREADS": "1", "SMS_LEAST_ROOM_MB": "2"}
        self._environment = os.environ | dict(environment) | own
        self._rng = rng
        self._day = Day(states)
        self._aimed_at: set[tuple[str, int]] = set()
        self._service: subprocess.Popen[bytes] | None = None

    def run(self, kills: int, say: Callable[[str], None]) -> Day:
        """Plan all states, kill so many times while they are recorded, and judge once all are."""
        before = dict(os.environ)
        os.environ.update(self._environment)
        try:
            self._prepare()
            with bootstrap.services(self._home) as services, _load_frame(self._home, self._day.states):
                planned_recordings.plan(services, CAMPAIGN, AtLoad("load_n", typed(TOLERANCE, "it"), HOLD_S))
                try:
                    self._follow(services, kills, say)
                finally:
                    self._end()
                self._judge(services)
        finally:
            os.environ.clear()
            os.environ.update(before)
        return self._day

    def _prepare(self) -> None:
        bootstrap.initialise(self._home)
        calibration, campaign = small_plate(CAMPAIGN)
        states = tuple(LoadState(f"S{n:02d}", _STEP_N * n) for n in range(self._day.states))
        campaign = replace(campaign, rig="bench", states=states, views=(_VIEW,), sequence=SEQUENCE)
        calibration = replace(calibration, rig=replace(calibration.rig, name="bench"))
        file = self._home / "rig.toml"
        file.write_text(_RIG.replace('"LOAD"', f"'{self._home / 'load.csv'}'"))
        with bootstrap.services(self._home) as services:
            register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
            services.stations.add(file, replace=False)

    def _follow(self, services: Services, kills: int, say: Callable[[str], None]) -> None:
        """Keep the service up, resume what breaks off, and kill, until every state is recorded."""
        kill_at = self._next_kill()
        deadline = time.monotonic() + _PATIENCE_S
        recorded = 0
        while recorded < self._day.states:
            self._keep_up()
            time.sleep(0.05)
            with suppress(ServerUnreachable):
                self._resume(services)
                if _recorded(services) > recorded:
                    recorded = _recorded(services)
                    deadline = time.monotonic() + _PATIENCE_S
                last = recorded == self._day.states - 1
                if (kill_at is None or last) and self._another_runs(services):
                    # The last recording meets the kills that are left: after it there is nothing to kill.
                    within = _WITHIN_LAST_S if last else _WITHIN_S
                    kill_at = time.monotonic() + self._rng.uniform(0.0, within)
            if self._day.kills < kills and kill_at is not None and time.monotonic() >= kill_at:
                whom = self._kill()
                say(f"{self._day.kills} of {kills} kills: {whom}; {recorded} of {self._day.states} recorded")
                kill_at = self._next_kill()
                deadline = time.monotonic() + _PATIENCE_S
            if time.monotonic() > deadline:
                raise SmsError(
                    f"nothing more was recorded within {_PATIENCE_S:.0f} s after {recorded} states"
                )

    def _next_kill(self) -> float | None:
        """Return when to kill next; None where that is once another recording has started."""
        if self._rng.random() < _AFTER_A_BEGINNING:
            return None
        return time.monotonic() + self._rng.uniform(0.0, _ANY_TIME_S)

    def _another_runs(self, services: Services) -> bool:
        """Say whether an attempt at a recording runs that no kill was aimed at before, and aim at it."""
        query = select(JobRow.id, JobRow.attempts).where(JobRow.state == JobState.RUNNING)
        with services.catalogue.reading() as session:
            running = {(job, attempt) for job, attempt in session.execute(query)} - self._aimed_at
        self._aimed_at |= running
        return bool(running)

    def _keep_up(self) -> None:
        """Begin the service again where it has ended, as the system does after a reboot."""
        if self._service is not None and self._service.poll() is None:
            return
        command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "up", "--home", str(self._home)]
        with (self._home / "up.log").open("ab") as log:
            self._service = subprocess.Popen(
                command, env=self._environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )

    def _kill(self) -> str:
        """Kill the supervisor, the processes below it, or both, and note what is in the spool then."""
        assert self._service is not None
        supervisor = psutil.Process(self._service.pid)
        below = supervisor.children(recursive=True)
        whom = str(self._rng.choice(["supervisor", "everything", "places"]))
        victims = {"supervisor": [supervisor], "everything": [supervisor, *below], "places": below}[whom]
        for victim in victims:
            with suppress(psutil.NoSuchProcess):
                victim.kill()
        # Places end by themselves with their supervisor; what they write until then is theirs, too.
        psutil.wait_procs(below, timeout=_PATIENCE_S)
        if whom != "places":
            self._service.wait()
        self._day.kills += 1
        for folder in (self._home / "spool").iterdir() if (self._home / "spool").is_dir() else ():
            self._note_broken(folder)
        return whom

    def _note_broken(self, spool: Path) -> None:
        """Note the sets of a job that broke off: nobody is there who could go on with them."""
        whole = {one.path.name for one in finished_sets(spool).values()}
        for path in spool.glob(f"{_VIEW}.*"):
            if path.suffix == ".json" or path.name in whole:
                continue
            with suppress(ArchiveCorrupt):  # it was made a moment ago, and has no header yet
                complete = min(Spooled(path).complete, SEQUENCE.frames)
                self._day.broken[path.with_suffix("")] = complete

    def _resume(self, services: Services) -> None:
        """Do what an operator does about a recording that broke off, while the load is still held."""
        broken = (JobState.NEEDS_OPERATOR, JobState.FAILED, JobState.QUARANTINED)
        with services.catalogue.reading() as session:
            found = session.scalars(select(JobRow.id).where(JobRow.state.in_(broken))).all()
        for job_id in found:
            with suppress(Conflict):
                recordings.resume(services, job_id)
                self._day.resumed += 1

    def _judge(self, services: Services) -> None:
        day = self._day
        with services.catalogue.reading() as session:
            jobs = session.execute(select(JobRow.id, JobRow.subject)).all()
            ended = select(EventRow.job_id).where(EventRow.state == JobState.SUCCEEDED)
            ends = list(session.scalars(ended))
            files = session.execute(
                select(FileRow.job_id, FileRow.path).where(FileRow.source == MEASUREMENT)
            ).all()
        for number in range(day.states):
            of_state = [job_id for job_id, subject in jobs if subject == f"{CAMPAIGN}/S{number:02d}"]
            made = [path for job_id, path in files if job_id in of_state]
            succeeded = sum(ends.count(job_id) for job_id in of_state)
            day.once += (len(of_state), len(made), succeeded) == (1, 1, 1)
            for job_id in of_state:
                self._count(services, job_id, made)
        shown = planned_recordings.show(services, CAMPAIGN)
        day.doubted = sum(one.note != "" for one in shown)

    def _count(self, services: Services, job_id: str, made: list[str]) -> None:
        """Compare the frames that came into the spool of a job with those in the archive."""
        broke_off = sum(count for path, count in self._day.broken.items() if path.parent.name == job_id)
        whole = interrupted = 0
        for path in made:
            with services.archive.open_unrecorded(path) as dataset:
                whole += MEASURED.read(dataset).frames.shape[0]
                for product in INTERRUPTED.among(dataset.names):
                    interrupted += len(product.read(dataset).numbers)
        self._day.delivered += SEQUENCE.frames + broke_off
        self._day.lost += max(SEQUENCE.frames - whole, 0) + max(broke_off - interrupted, 0)

    def _end(self) -> None:
        if self._service is not None and self._service.poll() is None:
            self._service.terminate()
            try:
                self._service.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._service.kill()
                self._service.wait()


def _recorded(services: Services) -> int:
    """Return how many states have a measurement."""
    query = select(func.count(FileRow.state_id.distinct())).where(FileRow.source == MEASUREMENT)
    with services.catalogue.reading() as session:
        return session.scalar(query) or 0


@contextmanager
def _load_frame(home: Path, states: int) -> Iterator[None]:
    """Software of a load frame: it ramps to a load, holds it until its state is recorded, and writes it."""
    over = threading.Event()

    def write() -> None:
        load_n = 0.0
        with bootstrap.services(home) as services, (home / "load.csv").open("w") as file:
            file.write("time,load\n")
            while not over.wait(0.1):
                target = _STEP_N * min(_recorded(services), states - 1)
                load_n += max(-_RAMP_N, min(_RAMP_N, target - load_n))
                file.write(f"{datetime.now(UTC).isoformat()},{load_n:.1f}\n")
                file.flush()

    thread = threading.Thread(target=write)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
