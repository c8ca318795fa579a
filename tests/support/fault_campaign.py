"""Many short jobs through the real service while faults are injected, and the proof that nothing was lost.

Two supervisors with two processes each serve one home. A seeded generator decides which fault comes when.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random
from typing import Any

import psutil
import pytest
from sqlalchemy import func, select, text

from sms_jobs import bootstrap
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow, OutboxRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.running.origin import Origin
from sms_jobs.jobs.running.witness import Witness
from sms_jobs.records.job import ACTIVE, TRANSITIONS, JobState
from sms_jobs.virtual_rig.campaigns import small_plate
from support.command import SMS, kill_all, sms, wait_until
from support.servers import PostgresqlServer, RedisServer

SETTINGS = {
    # It is the campaign that kills them, not the jobs: none is to be quarantined for it.
    "SMS_CRASH_BUDGET": "100",
    "SMS_LEAST_ROOM_MB": "2",
}
_PATIENCE_S = 900.0
_FREEZE_S = 8.0
"""How much longer than the lease something is frozen at most."""


@dataclass(frozen=True)
class Place:
    """Where a campaign runs, and what of it can be broken.

    Attributes
    ----------
    home, archive
        On a file system that may be filled up when `may_be_filled`.
    lease_s
        How long a job stays with a supervisor that gives no sign of life.
    processes
        For jobs, of each supervisor.
    postgresql, redis
        Servers of the grown deployment; None for both in the embedded one.
    """

    home: Path
    archive: Path
    may_be_filled: bool
    lease_s: float = 4.0
    processes: int = 2
    postgresql: PostgresqlServer | None = None
    redis: RedisServer | None = None
    settings: Mapping[str, str] = field(default_factory=dict)
    """That differ from those of every campaign."""

    @property
    def environment(self) -> dict[str, str]:
        """What tells `sms` about it."""
        known = SETTINGS | {"SMS_ARCHIVE": str(self.archive), "SMS_LEASE_S": str(self.lease_s)}
        known["SMS_WORKERS"] = str(self.processes)
        if self.postgresql is not None and self.redis is not None:
            known |= {"SMS_DATABASE_URL": self.postgresql.url, "SMS_BROKER_URL": self.redis.url}
        return known | dict(self.settings)

    def catalogue(self) -> Catalogue:
        """Open its catalogue."""
        embedded = f"sqlite:///{self.home / 'catalogue.sqlite'}"
        return Catalogue(embedded if self.postgresql is None else self.postgresql.url)


def _living(pid: int | None) -> psutil.Process | None:
    """Return a process; None for one that has ended, although nobody may have noticed yet."""
    if pid is None:
        return None
    with suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process
    return None


def _end_of(log: Path) -> str:
    """Return the last lines of a log."""
    return "\n".join(log.read_text(errors="replace").splitlines()[-20:])


def _label(number: int) -> str:
    return f"S{number:04d}"


def prepare(place: Place, states: int) -> None:
    """Make a home with a campaign of so many states and one view."""
    calibration, campaign = small_plate("plate")
    first, second = campaign.states
    assert second.time is not None
    later = (
        replace(second, label=_label(k), time=second.time + k * timedelta(minutes=1))
        for k in range(1, states)
    )
    campaign = replace(campaign, states=(first, *later), views=campaign.views[:1])
    with pytest.MonkeyPatch.context() as patch:
        for name, value in place.environment.items():
            patch.setenv(name, value)
        bootstrap.initialise(place.home)
        with bootstrap.services(place.home) as services:
            register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))


class FaultCampaign:
    """The service under fire.

    Attributes
    ----------
    jobs
        How many were submitted.
    injected
        How often each fault was met.
    kills
        Processes that were ended by SIGKILL.
    """

    def __init__(self, place: Place, seed: int, absence_s: float) -> None:
        self.place = place
        self.catalogue = place.catalogue()
        self.jobs = 0
        self.injected: Counter[str] = Counter()
        self.kills = 0
        self._random = Random(seed)
        self._absence_s = absence_s
        self._services: list[subprocess.Popen[bytes]] = []

    @property
    def faults(self) -> dict[str, Callable[[], bool]]:
        """Every fault that this place can meet; each returns whether it hit something."""
        known = {
            "busy process killed": self.kill_busy,
            "idle process killed": self.kill_idle,
            "busy process stopped": self.stop_busy,
            "nursery killed": self.kill_nursery,
            "supervisor killed, and with it the publisher": self.kill_supervisor,
            "supervisor and processes frozen past the lease, thawed": self.freeze,
            "broker killed": self.kill_broker,
            "broker back empty": self.empty_broker,
            "broker absent": self.take_broker_away,
            "killed between sealing and indexing": self.break_between_sealing_and_indexing,
            "clock an hour ahead": lambda: self.jump_clock(timedelta(hours=1)),
            "clock an hour behind": lambda: self.jump_clock(timedelta(hours=-1)),
        }
        if self.place.postgresql is not None:
            known["database restarted"] = self.restart_database
            known["database connections cut"] = self.cut_connections
        if self.place.may_be_filled:
            known["disk full"] = self.fill_disk
        return known

    @contextmanager
    def served(self) -> Iterator[None]:
        """Have two supervisors meanwhile, and end them in order."""
        try:
            self._services = [self._start() for _ in range(2)]
            yield
            for process in self._services:
                process.send_signal(signal.SIGTERM)
            for process in self._services:
                process.wait(timeout=_PATIENCE_S)
        finally:
            for process in self._services:
                if process.poll() is None:
                    kill_all(psutil.Process(process.pid))
                    process.wait()
            self.catalogue.close()

    def submit(self, *kinds: str, states: int = 0) -> None:
        """Submit jobs of some kinds about so many states, or all, to be computed whatever was before."""
        labels = tuple(_label(k) for k in range(1, states + 1))
        with self.catalogue.writing() as session:
            requests = [Request(kind, states=labels) for kind in kinds]
            done = submit(session, "plate", requests, datetime.now(UTC), Terms(use_cache=False))
        self.jobs += len(done.job_ids)

    def inject(self, name: str) -> bool:
        """Let a fault happen once there is a job that it can hit; False when it hit none after all."""
        began = time.monotonic()
        try:
            hit = self.left() > 0 and self.faults[name]()
        except (SmsError, psutil.Error):
            hit = False  # what it was aimed at ended by itself
        self.injected[name] += hit
        took = time.monotonic() - began
        print(f"{datetime.now(UTC):%H:%M:%S} {name}{'' if hit else ': missed'} ({took:.1f} s)", flush=True)
        for number, process in enumerate(self._services):
            if process.poll() is not None:
                self._services[number] = self._start()
        return hit

    def rest(self, most_jobs: int) -> None:
        """Let the service end a random number of jobs, at most so many, and work for a moment more."""
        enough = min(self._succeeded() + self._random.randint(0, most_jobs), self.jobs)
        self._wait_until(lambda: self._succeeded() >= enough)
        time.sleep(self._random.uniform(0.0, 0.2))

    def _succeeded(self) -> int:
        with self.catalogue.reading() as session:
            query = select(func.count()).select_from(JobRow).where(JobRow.state == JobState.SUCCEEDED)
            return session.scalar(query) or 0

    def shuffle(self, plan: list[str]) -> None:
        """Bring faults into a random order."""
        self._random.shuffle(plan)

    def left(self) -> int:
        """Return the number of jobs that have not ended."""
        with self.catalogue.reading() as session:
            query = select(func.count()).select_from(JobRow).where(JobRow.state.in_(ACTIVE))
            return session.scalar(query) or 0

    def settle(self) -> None:
        """Wait until every job has ended and every message has been sent."""
        self._wait_until(lambda: self.left() == self._unsent() == 0)

    def _wait_until(self, condition: Callable[[], Any]) -> Any:
        """Return what `condition()` returns once it is true; say what is left where it does not become so."""
        try:
            return wait_until(condition, timeout=_PATIENCE_S)
        except AssertionError as late:
            raise AssertionError(f"{late}:\n{self._what_is_left()}") from None

    def _what_is_left(self) -> str:
        """Return what has not ended, who should see to it, and what the service itself says of that."""
        with self.catalogue.reading() as session:
            jobs = session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE))).all()
        said = [
            f"{job.kind} {job.subject} is {job.state.value}, worker {job.worker_id}, process {job.pid}: "
            f"{job.message}"
            for job in jobs
        ]
        said.append(f"of {self.jobs} jobs {len(jobs)} are left, {self._unsent()} messages are not sent")
        for process in self._services:
            code = process.poll()
            said.append(f"supervisor {process.pid} {'lives' if code is None else f'ended with code {code}'}")
        doctor = sms("doctor", "--home", str(self.place.home), environment=self.place.environment)
        said.append(doctor.stdout + doctor.stderr)
        logs = [self._log, *sorted((self.place.home / "logs").glob("worker-*.log"))]
        said += [f"{log.name}:\n{_end_of(log)}" for log in logs]
        return "\n".join(said)

    def _unsent(self) -> int:
        with self.catalogue.reading() as session:
            return session.scalar(select(func.count()).select_from(OutboxRow)) or 0

    @property
    def _log(self) -> Path:
        """To which all supervisors write."""
        return self.place.home.parent / f"up-{self.place.home.name}.log"

    def _start(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as log:
            return subprocess.Popen(
                [*SMS, "up", "--home", str(self.place.home)],
                env=os.environ | self.place.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def _running(self) -> JobRow | None:
        with self.catalogue.reading() as session:
            jobs = session.scalars(select(JobRow).where(JobRow.state == JobState.RUNNING)).all()
        return self._random.choice(jobs) if jobs else None

    def _a_running_process(self) -> psutil.Process:
        def found() -> psutil.Process | None:
            if self.left() == 0:
                raise psutil.NoSuchProcess(0)
            job = self._running()
            return None if job is None else _living(job.pid)

        process: psutil.Process = self._wait_until(found)
        return process

    def _kill(self, process: psutil.Process) -> bool:
        process.kill()
        self.kills += 1
        return True

    def kill_busy(self) -> bool:
        return self._kill(self._a_running_process())

    def kill_idle(self) -> bool:
        with self.catalogue.reading() as session:
            busy = set(session.scalars(select(JobRow.pid).where(JobRow.state == JobState.RUNNING)))
        idle = [p for p in self._places() if p.pid not in busy]
        return bool(idle) and self._kill(self._random.choice(idle))

    def _nurseries(self) -> list[psutil.Process]:
        return [n for s in self._services for n in psutil.Process(s.pid).children()]

    def _places(self) -> list[psutil.Process]:
        """Return the processes for jobs, those included whose nursery is gone."""
        nurseries = {nursery.pid for nursery in self._nurseries()}
        found = []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                ours = "sms_jobs.workers.nursery" in process.cmdline() and process.pid not in nurseries
                if ours and process.environ().get("SMS_ARCHIVE") == str(self.place.archive):
                    found.append(process)
        return found

    def stop_busy(self) -> bool:
        """Stop what runs a job; its supervisor lets it go on."""
        stopped = self._a_running_process()
        stopped.suspend()
        wait_until(lambda: _living(stopped.pid) is None or stopped.status() != psutil.STATUS_STOPPED)
        return True

    def kill_nursery(self) -> bool:
        # Not the parent of what runs: a place outlives the nursery that forked it.
        self._a_running_process()
        nurseries = self._nurseries()
        return bool(nurseries) and self._kill(self._random.choice(nurseries))

    def _a_supervisor(self) -> psutil.Process:
        """Return the supervisor of a job that runs, if it can be told."""
        ours = {process.pid for process in self._services}
        above = [p for p in self._a_running_process().parents() if p.pid in ours]
        return above[0] if above else psutil.Process(self._random.choice(sorted(ours)))

    def kill_supervisor(self) -> bool:
        supervisor = self._a_supervisor()
        self._kill(supervisor)
        for process in self._services:
            if process.pid == supervisor.pid:
                process.wait()
        return True

    def freeze(self) -> bool:
        """Freeze what runs a job until the other supervisor has given it up, then let it go on."""
        supervisor = self._a_supervisor()
        frozen = [supervisor, *supervisor.children(recursive=True)]
        for process in frozen:
            process.suspend()
        try:
            pids = {process.pid for process in frozen}
            held = self._held_by(pids)
            lost: set[tuple[str, int]] = set()
            # It may hold a lock that the other waits for, or nobody else may be there.
            deadline = time.monotonic() + self.place.lease_s + _FREEZE_S
            while held and not lost and time.monotonic() < deadline:
                time.sleep(0.1)
                lost = held - self._held_by(pids)
        finally:
            for process in frozen:
                with suppress(psutil.NoSuchProcess):
                    process.resume()
        return len(lost) > 0

    def _held_by(self, pids: set[int]) -> set[tuple[str, int]]:
        """Return the attempts that processes run, as (job, fence)."""
        query = select(JobRow.id, JobRow.fence).where(JobRow.state == JobState.RUNNING, JobRow.pid.in_(pids))
        with self.catalogue.reading() as session:
            return {(job_id, fence) for job_id, fence in session.execute(query)}

    def kill_broker(self) -> bool:
        return self._broker_away(0.0, empty=False)

    def empty_broker(self) -> bool:
        return self._broker_away(0.0, empty=True)

    def take_broker_away(self) -> bool:
        return self._broker_away(self._absence_s, empty=False)

    def _broker_away(self, for_s: float, *, empty: bool) -> bool:
        if self.place.redis is not None:
            self.place.redis.kill()
            time.sleep(for_s)
            self.place.redis.start(empty=empty)
            return True
        # Files are their own broker: it is away when their folder is.
        folder = self.place.home / "messages" / "queue"
        away = folder.with_name("away")
        folder.rename(away)
        time.sleep(for_s)
        if empty:
            shutil.rmtree(away)
            away.mkdir()
        if folder.exists():  # a worker that started meanwhile has made one
            shutil.rmtree(folder)
        away.rename(folder)
        return True

    def break_between_sealing_and_indexing(self) -> bool:
        """Let nobody index a file until a job has sealed one, and kill that job."""
        self._a_running_process()
        with self.catalogue.writing() as session:
            if self.place.postgresql is not None:
                session.execute(text("LOCK TABLE file IN EXCLUSIVE MODE"))
            known = set(session.scalars(select(FileRow.path)))
            running = select(JobRow.id, JobRow.pid).where(JobRow.state == JobState.RUNNING)
            deadline = time.monotonic() + 10.0
            while time.monotonic() < deadline:
                new = [path for path in files_on_disk(self.place.archive) if path not in known]
                sealed = [path for path in new if not path.endswith(".tmp")]
                for job_id, pid in session.execute(running):
                    process = _living(pid)
                    if process is not None and any(job_id[:8] in path for path in sealed):
                        return self._kill(process)
                time.sleep(0.01)
        return False

    def jump_clock(self, by: timedelta) -> bool:
        """Have clocks that are wrong beat for every supervisor, and recover jobs a minute later by them."""
        self._a_running_process()
        now = datetime.now(UTC) + by
        with self.catalogue.writing() as session:
            query = select(JobRow.worker_id).where(JobRow.state == JobState.RUNNING).distinct()
            workers = [worker for worker in session.scalars(query) if worker is not None]
            for worker in workers:
                recovery.beat(session, worker, now)
            silent = Witness("elsewhere", Origin()).silent(session, time.monotonic())
            lost = recovery.recover(session, now + timedelta(minutes=1), "elsewhere", 100, set, silent)
        assert lost == []
        return len(workers) > 0

    def restart_database(self) -> bool:
        assert self.place.postgresql is not None
        self.place.postgresql.crash()
        self.place.postgresql.start()
        self.catalogue.close()
        return True

    def cut_connections(self) -> bool:
        assert self.place.postgresql is not None
        cut = self.place.postgresql.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE pid <> pg_backend_pid() AND backend_type = 'client backend'"
        )
        self.catalogue.close()
        return len(cut) > 0

    def fill_disk(self) -> bool:
        """Leave less room than a result takes for as long as some jobs need to find out."""
        disk = self.place.archive.parent
        size = shutil.disk_usage(disk).total

        def narrowed() -> bool:
            # A recording takes several times as much.
            return _remount(disk, f"size={shutil.disk_usage(disk).used + 30_000}")

        # What is written meanwhile may be more than that.
        wait_until(narrowed)
        try:
            time.sleep(2.0)
        finally:
            widened = _remount(disk, f"size={size}")
        return widened

    def make_read_only(self, for_s: float) -> bool:
        """Let nobody write to the disk of the archive for a while."""
        disk = self.place.archive.parent
        # It cannot be made so while somebody has a file open for writing.
        wait_until(lambda: _remount(disk, "ro"))
        time.sleep(for_s)
        return _remount(disk, "rw")


def _remount(disk: Path, how: str) -> bool:
    """Change how a disk is mounted; False where that cannot be done just now."""
    command = ["mount", "-o", f"remount,{how}", str(disk)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def files_on_disk(archive: Path) -> list[str]:
    """Return all that lies in the archive, documents without what stands beside them."""
    return [
        path.relative_to(archive).as_posix()
        for path in archive.rglob("*")
        if path.is_file() and ".logs" not in path.parts and not path.name.endswith(".provenance.json")
    ]


@dataclass(frozen=True)
class Verdict:
    """What became of the jobs.

    Attributes
    ----------
    jobs
        How many there are.
    lost
        Those that have not succeeded, or have no output.
    duplicated
        Those that succeeded more than once, or have more than one set of outputs.
    complaints
        All else that is not as it should be, in words.
    attempts
        How often jobs began: as often as there are jobs, and once more for every one that was hit.
    """

    jobs: int
    lost: tuple[str, ...] = ()
    duplicated: tuple[str, ...] = ()
    complaints: tuple[str, ...] = ()
    attempts: int = field(default=0, compare=False)


def judge(place: Place) -> Verdict:
    """Compare what the catalogue, the archive and the events say."""
    catalogue = place.catalogue()
    try:
        with catalogue.reading() as session:
            jobs = {job.id: job for job in session.scalars(select(JobRow))}
            events = session.scalars(select(EventRow).order_by(EventRow.id)).all()
            files = session.execute(select(FileRow.path, FileRow.job_id)).all()
            edges = session.scalars(select(DependencyRow)).all()
            unsent = session.scalar(select(func.count()).select_from(OutboxRow))
    finally:
        catalogue.close()
    made = Counter(job_id for _, job_id in files if job_id is not None)
    succeeded = Counter(e.job_id for e in events if e.state is JobState.SUCCEEDED)
    lost = [i for i, job in jobs.items() if job.state is not JobState.SUCCEEDED or made[i] < 1]
    # Every job of these kinds has one file, for there is one view.
    duplicated = [i for i in jobs if succeeded[i] > 1 or made[i] > 1]
    complaints = [f"{jobs[i].kind} {i} is {jobs[i].state.value}: {jobs[i].message}" for i in lost]

    known, there = {path for path, _ in files}, set(files_on_disk(place.archive))
    complaints += [f"{path} is not in the catalogue" for path in sorted(there - known)]
    complaints += [f"{path} is not on the disk" for path in sorted(known - there)]

    begun: dict[str, int] = {}
    ended: dict[str, int] = {}
    last: dict[str, JobState] = {}
    for event in events:
        before = last.get(event.job_id)
        if before is None and event.state not in (JobState.WAITING, JobState.QUEUED):
            complaints.append(f"job {event.job_id} began as {event.state.value}")
        if before is not None and event.state not in TRANSITIONS[before]:
            complaints.append(f"job {event.job_id} went from {before.value} to {event.state.value}")
        last[event.job_id] = event.state
        if event.state is JobState.RUNNING:
            begun.setdefault(event.job_id, event.id)
        if event.state is JobState.SUCCEEDED:
            ended[event.job_id] = event.id
    complaints += [f"job {i} is not what its events say" for i in jobs if last[i] is not jobs[i].state]
    complaints += [
        f"job {edge.job_id} ran before {edge.producer_id} had ended"
        for edge in edges
        if edge.producer_id is not None
        and edge.job_id in begun
        and begun[edge.job_id] < ended.get(edge.producer_id, 1 << 62)
    ]
    if unsent:
        complaints.append(f"{unsent} messages were not sent")
    attempts = sum(job.attempts for job in jobs.values())
    return Verdict(len(jobs), tuple(lost), tuple(duplicated), tuple(complaints), attempts)
