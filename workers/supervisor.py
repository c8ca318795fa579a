"""Looks after one Celery worker: starts it, renews the leases of its jobs, and recovers lost ones.

It is a process of its own, so that native code in a job, which may hold the interpreter for minutes,
cannot keep it from giving the sign of life. Every supervisor also recovers the jobs of others.
"""

from __future__ import annotations

import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from types import FrameType

import psutil
from sqlalchemy import exists, select

from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import upkeep
from sms_jobs.catalogue.models import JobRow
from sms_jobs.errors import SmsError, StorageFull
from sms_jobs.jobs import limits, queues, recovery, schedules
from sms_jobs.jobs.limits import Force, Limits
from sms_jobs.jobs.runner import require_room
from sms_jobs.records.job import ACTIVE, ALIVE_WITHIN
from sms_jobs.settings import Settings
from sms_jobs.workers.celery_app import ALL_QUEUES, WORKER_ID, WORKER_QUEUES, make_app, message_queue
from sms_jobs.workers.publisher import Publisher

logger = logging.getLogger(__name__)

_TICK_S = 0.2
_RECOVER_EVERY_S = 1.0
_BEAT_EVERY_S = ALIVE_WITHIN.total_seconds() / 3
"""Or more often, where leases are shorter."""
_ANALYSE_EVERY_S = 3600.0
_RESTART_AFTER_S = 2.0
_ALONE_S = 120.0
"""How long a worker may be without processes for jobs, as when it starts; after that it hangs."""
_PATIENCE_WITH_JOBS_S = 600.0
"""How long a worker that is told to stop may finish what it runs."""


class Supervisor:
    """One worker and all that keeps it and its jobs alive.

    Parameters
    ----------
    services
        Of the home.
    queues
        Names of the job queues that are served; may say that of every rig.
    """

    def __init__(self, services: Services, queues: Sequence[str] = ALL_QUEUES) -> None:
        self.worker_id = secrets.token_hex(4)
        self._services = services
        self._settings = services.settings
        self._queues = tuple(queues)
        self._lease = timedelta(seconds=self._settings.lease_s)
        self._limits = limits_of(self._settings)
        self._host = socket.gethostname()
        self._served = services.stations.served(self._queues)
        self._app = make_app(self._settings, self._served)
        self._process: subprocess.Popen[bytes] | None = None
        self._company: Company | None = None
        self._stop_asked = 0
        self._idle = False

    def run(self, *, until_idle: bool = False) -> None:
        """Serve until a signal asks to stop, or, if wished, until no job is left that can run."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask_to_stop)
        with self._services.catalogue.writing() as session:
            recovery.register_worker(
                session,
                self.worker_id,
                self._host,
                os.getpid(),
                self._served,
                self._settings.workers,
                datetime.now(UTC),
            )
        publisher = Publisher(self._app, self._services.catalogue, self._settings.workers)
        self._start_worker()
        publisher.start()
        try:
            self._serve(until_idle)
        finally:
            publisher.stop()
            publisher.join(timeout=5.0)
            self._stop_worker()

    def _serve(self, until_idle: bool) -> None:
        beat_at = recover_at = analyse_at = 0.0
        while not self._stop_asked:
            moment = time.monotonic()
            if moment >= beat_at and self._done(self._beat):
                beat_at = moment + min(self._settings.lease_s / 3, _BEAT_EVERY_S)
            if moment >= analyse_at:
                analyse_at = moment + _ANALYSE_EVERY_S
                self._done(self._analyse)
            if moment >= recover_at:
                duties = (
                    self._look_for_rigs,
                    self._fire_schedules,
                    self._enforce,
                    self._recover,
                    self._end_if_alone,
                    self._look_whether_idle,
                )
                if sum(map(self._done, duties)) == len(duties):
                    recover_at = moment + _RECOVER_EVERY_S
                    if until_idle and self._idle:
                        return
            self._restart_if_dead()
            time.sleep(_TICK_S)

    def _look_for_rigs(self) -> None:
        """Note rigs that have come or gone; the processes of the worker see them by themselves."""
        served = self._services.stations.served(self._queues)
        if served != self._served:
            with self._services.catalogue.writing() as session:
                recovery.note_queues(session, self.worker_id, served)
            self._served = served
            logger.info("serving %s from now on", ", ".join(served))

    def _end_if_alone(self) -> None:
        """End a worker that lives without processes for jobs: an error may leave it so, for ever."""
        if self._process is None or self._company is None or self._process.poll() is not None:
            return
        if self._company.missed_s(time.monotonic()) > _ALONE_S:
            logger.error("the worker has had no process for jobs for %.0f s; killing it", _ALONE_S)
            self._process.kill()

    def _done(self, duty: Callable[[], None]) -> bool:
        """Do one duty; False when it could not be done, which keeps the supervisor from no other."""
        try:
            duty()
        except SmsError as error:
            # The catalogue is away or its disk is full: both pass, and jobs go on meanwhile.
            logger.warning("%s", error)
            return False
        except Exception:
            # Whatever it is, jobs would be lost with a supervisor that ends for it.
            logger.exception("a duty failed; trying again")
            return False
        return True

    def _beat(self) -> None:
        with self._services.catalogue.writing() as session:
            recovery.beat(session, self.worker_id, datetime.now(UTC), self._lease, process_lives)

    def _recover(self) -> None:
        with self._services.catalogue.writing() as session:
            lost = recovery.recover(
                session, datetime.now(UTC), self._host, self._settings.crash_budget, process_lives
            )
        for job_id in lost:
            logger.warning("job %s was lost", job_id)

    def _enforce(self) -> None:
        """Ask jobs that take too much to stop, end those that do not, let queues go on that have room."""
        now = datetime.now(UTC)
        with self._services.catalogue.writing() as session:
            for job_id in limits.ask_those_over_limit(
                session, self.worker_id, now, self._limits, memory_of_process
            ):
                logger.warning("job %s is over its limit and asked to stop", job_id)
            late = limits.overdue(session, self.worker_id, now, self._limits)
        for job in late:
            logger.warning("job %s does not stop: %s process %d", job.job_id, job.force.value, job.pid)
            end_process(job.pid, job.began, job.force)
        self._go_on_when_there_is_room()

    def _fire_schedules(self) -> None:
        with self._services.catalogue.writing() as session:
            fired = schedules.fire_due(session, datetime.now(UTC))
        for one in fired:
            logger.info("schedule %s, %s: %s", one.schedule, one.fire_time, one.outcome)

    def _go_on_when_there_is_room(self) -> None:
        with self._services.catalogue.reading() as session:
            if not any(queue.for_room for queue in queues.queues(session)):
                return
        try:
            require_room(self._services.archive.root, self._settings.least_room_mb)
        except StorageFull:
            return
        with self._services.catalogue.writing() as session:
            resumed = queues.resume_for_room(session)
        logger.info("there is room again: %s go on", ", ".join(resumed))

    def _analyse(self) -> None:
        upkeep.analyse(self._services.catalogue)

    def _look_whether_idle(self) -> None:
        with self._services.catalogue.reading() as session:
            self._idle = not session.scalar(select(exists().where(JobRow.state.in_(ACTIVE))))

    def _start_worker(self) -> None:
        threads = str(self._settings.threads)
        environment = os.environ | {
            "SMS_HOME": str(self._settings.home),
            WORKER_ID: self.worker_id,
            WORKER_QUEUES: ",".join(self._queues),
            # One worker process uses as many threads as it was given, and its libraries no more.
            "OMP_NUM_THREADS": threads,
            "OPENBLAS_NUM_THREADS": threads,
            "MKL_NUM_THREADS": threads,
        }
        command = [sys.executable, "-m", "celery", "-A", "sms_jobs.workers.tasks", "worker"]
        command += ["--pool", "prefork", "--concurrency", str(self._settings.workers)]
        command += ["--queues", ",".join(message_queue(queue) for queue in self._served)]
        command += ["--hostname", f"sms-{self.worker_id}@%h", "--loglevel", "INFO"]
        command += ["--without-gossip", "--without-mingle", "--without-heartbeat"]
        self._settings.log_folder.mkdir(parents=True, exist_ok=True)
        with (self._settings.log_folder / f"worker-{self.worker_id}.log").open("ab") as output:
            # A group of its own: Ctrl-C reaches the supervisor alone, which then ends the worker in order.
            self._process = subprocess.Popen(
                command,
                env=environment,
                stdout=output,
                stderr=output,
                stdin=subprocess.DEVNULL,
                process_group=0,
            )
        self._company = Company(self._process.pid, time.monotonic())
        logger.info("worker %s started as process %d", self.worker_id, self._process.pid)

    def _restart_if_dead(self) -> None:
        if self._process is not None and self._process.poll() is not None:
            logger.error("the worker process ended with code %d; starting another", self._process.returncode)
            time.sleep(_RESTART_AFTER_S)
            self._start_worker()

    def _stop_worker(self) -> None:
        if self._process is None or self._process.poll() is not None:
            return
        try:
            with self._services.catalogue.writing() as session:
                recovery.drain(session, self.worker_id)
        except SmsError as error:
            logger.warning("%s", error)
        self._process.terminate()
        deadline = time.monotonic() + _PATIENCE_WITH_JOBS_S
        while self._process.poll() is None and time.monotonic() < deadline and self._stop_asked < 2:
            self._beat_quietly()
            time.sleep(_TICK_S)
        if self._process.poll() is None:
            logger.warning("the worker does not end; killing it, its jobs will be run again")
            for child in psutil.Process(self._process.pid).children(recursive=True):
                child.kill()
            self._process.kill()
            self._process.wait()

    def _beat_quietly(self) -> None:
        try:
            self._beat()
        except SmsError as error:
            logger.warning("%s", error)

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        self._stop_asked += 1


class Company:
    """Tells how long a process has had no child.

    Parameters
    ----------
    pid
        Of the process.
    now
        Seconds of a monotonic clock.
    """

    def __init__(self, pid: int, now: float) -> None:
        self._pid = pid
        self._last = now

    def missed_s(self, now: float) -> float:
        """Look, and return the seconds since the process was last seen with a child."""
        try:
            children = psutil.Process(self._pid).children()
        except psutil.NoSuchProcess:
            children = []
        if any(child.status() != psutil.STATUS_ZOMBIE for child in children):
            self._last = now
        return now - self._last


def limits_of(settings: Settings) -> Limits:
    """Return what a job may take."""
    time_s = settings.job_time_limit_s
    return Limits(
        timedelta(seconds=time_s) if time_s else None,
        settings.job_memory_limit_mb or None,
        timedelta(seconds=settings.stop_grace_s),
    )


def memory_of_process(pid: int) -> float | None:
    """Return the resident memory of a process in MB; None when it is gone."""
    try:
        return float(psutil.Process(pid).memory_info().rss) / 2**20
    except psutil.NoSuchProcess:
        return None


def end_process(pid: int, before: datetime, force: Force) -> None:
    """End a process that began before a time, if it is still there."""
    if process_lives(pid, before):
        os.kill(pid, signal.SIGKILL if force is Force.KILL else signal.SIGTERM)


def process_lives(pid: int, before: datetime) -> bool:
    """Tell whether a process of this host that began before a time is alive."""
    try:
        process = psutil.Process(pid)
        # A process that is younger than its claim has only inherited the number.
        started = float(process.create_time())
        return started <= before.timestamp() + 1.0 and process.status() != str(psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
