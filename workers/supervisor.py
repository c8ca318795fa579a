"""Looks after the processes that run jobs: keeps them in their places, and recovers lost jobs.

It is a process of its own, so that native code in a job, which may hold the interpreter for minutes,
cannot keep it from giving the sign of life. Every supervisor also recovers the jobs of others.
"""

from __future__ import annotations

import logging
import os
import secrets
import signal
import socket
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from types import FrameType

import psutil
from sqlalchemy import exists, func, select

from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import job_counts, sealing, upkeep
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.running import limits, recovery
from sms_jobs.jobs.running.limits import Limits, Watch
from sms_jobs.jobs.running.origin import Origin
from sms_jobs.jobs.running.witness import Witness
from sms_jobs.jobs.scheduling import firing
from sms_jobs.records.job import ACTIVE, ALIVE_WITHIN, JobState
from sms_jobs.records.sizes import number_of
from sms_jobs.settings import Settings
from sms_jobs.workers.archive_watch import ArchiveWatch
from sms_jobs.workers.celery_app import ALL_QUEUES, WORKER_ID, WORKER_QUEUES, make_app
from sms_jobs.workers.notifier import Notifier
from sms_jobs.workers.places import Places
from sms_jobs.workers.planning import Planning
from sms_jobs.workers.publisher import Publisher

logger = logging.getLogger(__name__)

_TICK_S = 0.2
_RECOVER_EVERY_S = 1.0
_BEAT_EVERY_S = ALIVE_WITHIN.total_seconds() / 3
"""Or more often, where leases are shorter."""
_ANALYSE_EVERY_S = 3600.0
_PATIENCE_WITH_BROKER_S = 5.0
_PATIENCE_WITH_RECEIVERS_S = 5.0
"""What is being sent then may be sent again by the next supervisor."""
_PATIENCE_WITH_INSTRUMENTS_S = 5.0
"""What is being read then is let go of with the process, and its rig is free when its lease ends."""
_QUEUE_READY_EVERY_S = 30.0
_SEAL_EVERY_S = 5.0
_FOLD_EVERY_S = 20.0
_REGISTER_AGAIN_S = 1.0
_PATIENCE_WITH_JOBS_S = 600.0
"""How long jobs that run may take to end when the service is asked to stop."""


class Supervisor:
    """Processes for jobs, and all that keeps them and their jobs alive.

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
        self._limits = limits_of(self._settings)
        self._served = services.stations.served(self._queues)
        self._app = make_app(self._settings, self._served)
        self._origin = Origin.own()
        self._witness = Witness(self.worker_id, self._origin)
        self._watch = Watch()
        self._places = Places(
            self._settings.workers,
            self._environment(),
            self._settings.log_folder / f"worker-{self.worker_id}.log",
        )
        self._processes_reported = 0
        self._stop_asked = 0
        self._idle = False

    def run(self, *, until_idle: bool = False) -> None:
        """Serve until a signal asks to stop, or, if wished, until no job is left that can run."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask_to_stop)
        while not self._registered():
            time.sleep(_REGISTER_AGAIN_S)
            if self._stop_asked:
                return
        publisher = Publisher(self._app, self._services.catalogue, self._settings.workers)
        watch = ArchiveWatch(self._services, self.worker_id)
        notifier = Notifier(self._services)
        planning = Planning(self._services, self.worker_id, lambda: self._served)
        publisher.start()
        watch.start()
        notifier.start()
        planning.start()
        self._places.start()
        try:
            self._serve(until_idle)
        finally:
            watch.stop()
            planning.stop()
            notifier.stop()
            publisher.stop()
            self._stop()
            publisher.join(timeout=_PATIENCE_WITH_BROKER_S)
            notifier.join(timeout=_PATIENCE_WITH_RECEIVERS_S)
            planning.join(timeout=_PATIENCE_WITH_INSTRUMENTS_S)

    def _registered(self) -> bool:
        """Enter this worker; False where that may go better later. What does not pass ends the service."""
        try:
            with self._services.catalogue.writing() as session:
                if session.get(WorkerRow, self.worker_id) is None:  # or nobody heard that it was entered
                    recovery.register_worker(
                        session,
                        self.worker_id,
                        socket.gethostname(),
                        os.getpid(),
                        self._served,
                        self._settings.workers,
                        datetime.now(UTC),
                        origin=self._origin,
                        lease=timedelta(seconds=self._settings.lease_s),
                    )
        except SmsError as error:
            if not error.retryable:
                raise
            logger.warning("%s", error)
            return False
        return True

    def _serve(self, until_idle: bool) -> None:
        beat_at = recover_at = analyse_at = queue_ready_at = seal_at = fold_at = 0.0
        while not self._stop_asked:
            moment = time.monotonic()
            if moment >= beat_at and self._done(self._beat):
                beat_at = moment + min(self._settings.lease_s / 3, _BEAT_EVERY_S)
            if moment >= analyse_at:
                analyse_at = moment + _ANALYSE_EVERY_S
                self._done(self._analyse)
            if moment >= queue_ready_at:
                queue_ready_at = moment + _QUEUE_READY_EVERY_S
                self._done(self._queue_ready)
            if moment >= seal_at:
                seal_at = moment + _SEAL_EVERY_S
                self._done(self._seal)
            if moment >= fold_at:
                fold_at = moment + _FOLD_EVERY_S
                self._done(self._fold_counts)
            if moment >= recover_at:
                duties = (
                    self._look_for_rigs,
                    self._fire_schedules,
                    self._enforce,
                    self._recover,
                    self._report_processes,
                    self._look_whether_idle,
                )
                if sum(map(self._done, duties)) == len(duties):
                    recover_at = moment + _RECOVER_EVERY_S
                    if until_idle and self._idle:
                        return
            time.sleep(_TICK_S)

    def _look_for_rigs(self) -> None:
        """Note rigs that have come or gone; the processes of the worker see them by themselves."""
        served = self._services.stations.served(self._queues)
        if served != self._served:
            with self._services.catalogue.writing() as session:
                recovery.note_queues(session, self.worker_id, served)
            self._served = served
            logger.info("serving %s from now on", ", ".join(served))

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
            processes = len(self._places.living())
            recovery.beat(session, self.worker_id, datetime.now(UTC), processes)
        self._processes_reported = processes

    def _report_processes(self) -> None:
        if len(self._places.living()) != self._processes_reported:
            self._beat()

    def _recover(self) -> None:
        with self._services.catalogue.writing() as session:
            lost = recovery.recover(
                session,
                datetime.now(UTC),
                self.worker_id,
                self._settings.crash_budget,
                self._places.living,
                self._witness.silent(session, time.monotonic()),
            )
        for job_id in lost:
            logger.warning("job %s was lost", job_id)

    def _queue_ready(self) -> None:
        for job_id in recovery.queue_ready(self._services.catalogue, datetime.now(UTC)):
            logger.warning("job %s had all that it needs and was not queued", job_id)

    def _enforce(self) -> None:
        """Ask jobs that take too much to stop, and end those that do not."""
        self._places.busy(None)
        with self._services.catalogue.writing() as session:
            running = self._watch.look(session, self.worker_id, time.monotonic())
            for job_id in limits.ask_those_over_limit(
                session, running, datetime.now(UTC), self._limits, memory_of_process
            ):
                logger.warning("job %s is over its limit and asked to stop", job_id)
        self._places.busy([job.pid for job in running])
        for job in limits.overdue(running, self._limits):
            logger.warning("job %s does not stop: %s process %d", job.job_id, job.force.value, job.pid)
            self._places.end(job.pid, job.force)

    def _fire_schedules(self) -> None:
        for one in firing.fire_due(self._services.catalogue, datetime.now(UTC)):
            logger.info("schedule %s, %s: %s", one.schedule, one.fire_time, one.outcome)

    def _analyse(self) -> None:
        upkeep.analyse(self._services.catalogue)

    def _fold_counts(self) -> None:
        job_counts.fold(self._services.catalogue)

    def _seal(self) -> None:
        sealing.seal(self._services.catalogue, datetime.now(UTC))

    def _look_whether_idle(self) -> None:
        with self._services.catalogue.reading() as session:
            self._idle = not session.scalar(select(exists().where(JobRow.state.in_(ACTIVE))))

    def _environment(self) -> dict[str, str]:
        threads = str(self._settings.threads)
        return os.environ | {
            "SMS_HOME": str(self._settings.home),
            WORKER_ID: self.worker_id,
            WORKER_QUEUES: ",".join(self._queues),
            # One process uses as many threads as it was given, and its libraries no more.
            "OMP_NUM_THREADS": threads,
            "OPENBLAS_NUM_THREADS": threads,
            "MKL_NUM_THREADS": threads,
        }

    def _stop(self) -> None:
        """Let jobs that run end, and kill what does not end in time or at the second word."""
        self._places.drain()
        self._done(self._claim_nothing)
        enforce_at = 0.0
        deadline = time.monotonic() + _PATIENCE_WITH_JOBS_S
        while self._places.living() and time.monotonic() < deadline and self._stop_asked < 2:
            if time.monotonic() >= enforce_at:
                enforce_at = time.monotonic() + _RECOVER_EVERY_S
                self._done(self._beat)
                self._done(self._enforce)
            time.sleep(_TICK_S)
        late = self._places.living()
        self._places.close()
        if late:
            logger.warning(
                "%d processes did not end and were killed; of their jobs recordings wait for an operator, "
                "and the others are run again",
                len(late),
            )
            self._done(self._recover)
        self._done(self._seal)

    def _claim_nothing(self) -> None:
        with self._services.catalogue.writing() as session:
            recovery.drain(session, self.worker_id)
            mine = (JobRow.worker_id == self.worker_id, JobRow.state == JobState.RUNNING)
            running = session.scalar(select(func.count()).where(*mine)) or 0
        if running:
            logger.info(
                "stopping: waiting for %s to end, for at most %.0f min; Ctrl-C again kills what runs",
                number_of(running, "running job"),
                _PATIENCE_WITH_JOBS_S / 60.0,
            )

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        self._stop_asked += 1


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
