"""What a monitoring system reads: numbers about jobs, queues, workers, archive and schedules, as of now."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta

from prometheus_client.core import GaugeMetricFamily as Gauge
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue import job_counts
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.schedules import ScheduleFireRow, ScheduleRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.running import queues
from sms_jobs.jobs.scheduling.fire_times import parse_expression, times_until
from sms_jobs.records.job import ALIVE_WITHIN, JobState

_REMEMBERED_FOR = timedelta(hours=1)
"""For so long a worker that vanished is reported; one that ended in order is not."""


class Numbers(Collector):
    """The numbers of a home whenever it is asked; one says whether the catalogue answers."""

    def __init__(self, catalogue: Catalogue, archive: Archive) -> None:
        self._catalogue = catalogue
        self._archive = archive

    def collect(self) -> Iterable[Gauge]:
        """Return every metric as of now; where the catalogue is away, that alone."""
        try:
            with self._catalogue.reading() as session:
                found = gather(session, self._archive, datetime.now(UTC))
        except (SmsError, OSError):
            found = []
        return [Gauge("sms_catalogue_up", "1 when the catalogue answers.", value=bool(found)), *found]


def gather(session: Session, archive: Archive, now: datetime) -> list[Gauge]:
    """Return every metric; none holds a secret, a path or a person's name."""
    return [
        *_of_jobs(session, now),
        *_of_queues(session, now),
        *_of_workers(session, now),
        *_of_archive(session, archive),
        _of_schedules(session, now),
    ]


def _of_jobs(session: Session, now: datetime) -> list[Gauge]:
    jobs = Gauge("sms_jobs", "Jobs in the catalogue, by kind and state.", labels=["kind", "state"])
    counted = job_counts.counted(session, JobCountRow.kind, JobCountRow.state)
    for (kind, state), count in sorted(counted.items(), key=lambda one: (one[0][0], one[0][1].value)):
        jobs.add_metric([kind, state.value], count)
    running = Gauge(
        "sms_running_seconds", "For how long the longest running job of a kind has run.", labels=["kind"]
    )
    for kind, since in session.execute(
        select(JobRow.kind, func.min(JobRow.started_at))
        .where(JobRow.state == JobState.RUNNING)
        .group_by(JobRow.kind)
    ):
        running.add_metric([kind], (now - since).total_seconds() if since else 0.0)
    return [jobs, running]


def _of_queues(session: Session, now: datetime) -> list[Gauge]:
    depth = Gauge("sms_queue_jobs", "Jobs of a queue that could run and do not yet.", labels=["queue"])
    paused = Gauge("sms_queue_paused", "1 while no job of a queue may begin.", labels=["queue"])
    oldest = Gauge(
        "sms_queue_oldest_seconds",
        "How long a queue's oldest such job has been queued; 0 if none.",
        labels=["queue"],
    )
    # A job that was retried has been queued since the retry, whenever it was submitted.
    queued_at = (
        select(func.max(EventRow.at))
        .where(EventRow.job_id == JobRow.id, EventRow.state == JobState.QUEUED)
        .correlate(JobRow)
        .scalar_subquery()
    )
    queued = select(JobRow.queue, queued_at.label("at")).where(JobRow.state == JobState.QUEUED).subquery()
    since = dict(
        session.execute(select(queued.c.queue, func.min(queued.c.at)).group_by(queued.c.queue)).all()
    )
    for queue in queues.queues(session):
        at = since.get(queue.name)
        depth.add_metric([queue.name], queue.queued)
        paused.add_metric([queue.name], queue.paused_at is not None)
        oldest.add_metric([queue.name], (now - at).total_seconds() if at else 0.0)
    return [depth, paused, oldest]


def _of_workers(session: Session, now: datetime) -> list[Gauge]:
    alive = Gauge("sms_workers_alive", "Workers that have given a sign of life within a minute.")
    age = Gauge(
        "sms_worker_beat_seconds",
        "How long ago a worker gave its last sign of life.",
        labels=["worker", "host"],
    )
    running = Gauge("sms_worker_jobs", "Jobs that a worker runs.", labels=["worker", "host"])
    places = Gauge(
        "sms_worker_places", "Jobs that a worker can run at the same time.", labels=["worker", "host"]
    )
    draining = Gauge("sms_worker_draining", "1 when a worker claims no more jobs.", labels=["worker", "host"])
    held = Gauge(
        "sms_worker_held",
        "1 while a worker claims none because it cannot use the archive.",
        labels=["worker", "host"],
    )
    counted = dict(
        session.execute(
            select(JobRow.worker_id, func.count())
            .where(JobRow.state == JobState.RUNNING)
            .group_by(JobRow.worker_id)
        ).all()
    )
    count = 0
    for row in session.scalars(
        select(WorkerRow).where(WorkerRow.beat_at >= now - _REMEMBERED_FOR).order_by(WorkerRow.started_at)
    ):
        silent = now - row.beat_at
        lives = silent <= ALIVE_WITHIN
        if row.draining and not lives:
            continue
        count += lives
        labels = [row.id, row.host]
        age.add_metric(labels, silent.total_seconds())
        running.add_metric(labels, counted.get(row.id, 0))
        places.add_metric(labels, row.concurrency)
        draining.add_metric(labels, row.draining)
        held.add_metric(labels, row.held_for is not None)
    alive.add_metric([], count)
    return [alive, age, running, places, draining, held]


def _of_archive(session: Session, archive: Archive) -> list[Gauge]:
    files = Gauge(
        "sms_archive_files",
        "Files of the archive that the catalogue knows, by what they are.",
        labels=["source"],
    )
    size = Gauge("sms_archive_bytes", "Their size.", labels=["source"])
    for source, count, total in session.execute(
        select(FileRow.source, func.count(), func.sum(FileRow.size_bytes))
        .group_by(FileRow.source)
        .order_by(FileRow.source)
    ):
        files.add_metric([source], count)
        size.add_metric([source], int(total))
    disk = archive.room()
    free = Gauge("sms_archive_free_bytes", "Room left on the archive's disk.")
    free.add_metric([], disk.free_bytes)
    whole = Gauge("sms_archive_disk_bytes", "Size of the archive's disk.")
    whole.add_metric([], disk.whole_bytes)
    return [files, size, free, whole]


def _of_schedules(session: Session, now: datetime) -> Gauge:
    lag = Gauge(
        "sms_schedule_lag_seconds",
        "By how much a schedule's first unfired time is overdue; 0 if none is.",
        labels=["schedule"],
    )
    last = (
        select(func.max(ScheduleFireRow.fire_time))
        .where(ScheduleFireRow.schedule_id == ScheduleRow.id, ScheduleFireRow.fire_time <= now)
        .correlate(ScheduleRow)
        .scalar_subquery()
    )
    for row, fired in session.execute(
        select(ScheduleRow, last).where(ScheduleRow.paused.is_(False)).order_by(ScheduleRow.name)
    ):
        expression = parse_expression(row.expression, row.time_zone)
        if expression.form == "after":
            continue  # it has no time that it could be late for
        due = times_until(expression, row.created_at, fired or row.created_at, now, 1)
        lag.add_metric([row.name], (now - due[0]).total_seconds() if due else 0.0)
    return lag
