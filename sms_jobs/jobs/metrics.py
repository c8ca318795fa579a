"""What a monitoring system reads: numbers about jobs, queues, workers, archive and schedules, as of now."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue.models import EventRow, FileRow, JobRow, ScheduleFireRow, ScheduleRow, WorkerRow
from sms_jobs.jobs import queues
from sms_jobs.jobs.fire_times import parse_expression, times_until
from sms_jobs.records.job import ALIVE_WITHIN, JobState

_REMEMBERED_FOR = timedelta(hours=1)
"""For so long a worker that vanished is reported; one that ended in order is not."""


@dataclass(frozen=True)
class Metric:
    """A gauge: one number for each set of labels."""

    name: str
    meaning: str
    samples: list[tuple[Mapping[str, str], float]] = field(default_factory=list)

    def add(self, value: float, **labels: str) -> None:
        """Add the number for some labels."""
        self.samples.append((labels, float(value)))


def gather(session: Session, archive: Archive, now: datetime) -> list[Metric]:
    """Return every metric; none holds a secret, a path or a person's name."""
    return [
        *_of_jobs(session, now),
        *_of_queues(session, now),
        *_of_workers(session, now),
        *_of_archive(session, archive),
        _of_schedules(session, now),
    ]


def _of_jobs(session: Session, now: datetime) -> list[Metric]:
    jobs = Metric("sms_jobs", "Jobs in the catalogue, by kind and state.")
    for kind, state, count in session.execute(
        select(JobRow.kind, JobRow.state, func.count())
        .group_by(JobRow.kind, JobRow.state)
        .order_by(JobRow.kind, JobRow.state)
    ):
        jobs.add(count, kind=kind, state=state.value)
    running = Metric("sms_running_seconds", "For how long the longest running job of a kind has run.")
    for kind, since in session.execute(
        select(JobRow.kind, func.min(JobRow.started_at))
        .where(JobRow.state == JobState.RUNNING)
        .group_by(JobRow.kind)
    ):
        running.add((now - since).total_seconds() if since else 0.0, kind=kind)
    return [jobs, running]


def _of_queues(session: Session, now: datetime) -> list[Metric]:
    depth = Metric("sms_queue_jobs", "Jobs of a queue that could run and do not yet.")
    paused = Metric("sms_queue_paused", "1 while no job of a queue may begin.")
    oldest = Metric(
        "sms_queue_oldest_seconds", "How long a queue's oldest such job has been queued; 0 if none."
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
        depth.add(queue.queued, queue=queue.name)
        paused.add(queue.paused_at is not None, queue=queue.name)
        oldest.add((now - at).total_seconds() if at else 0.0, queue=queue.name)
    return [depth, paused, oldest]


def _of_workers(session: Session, now: datetime) -> list[Metric]:
    alive = Metric("sms_workers_alive", "Workers that have given a sign of life within a minute.")
    age = Metric("sms_worker_beat_seconds", "How long ago a worker gave its last sign of life.")
    running = Metric("sms_worker_jobs", "Jobs that a worker runs.")
    places = Metric("sms_worker_places", "Jobs that a worker can run at the same time.")
    draining = Metric("sms_worker_draining", "1 when a worker claims no more jobs.")
    held = Metric("sms_worker_held", "1 while a worker claims none because it cannot use the archive.")
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
        labels = {"worker": row.id, "host": row.host}
        age.add(silent.total_seconds(), **labels)
        running.add(counted.get(row.id, 0), **labels)
        places.add(row.concurrency, **labels)
        draining.add(row.draining, **labels)
        held.add(row.held_for is not None, **labels)
    alive.add(count)
    return [alive, age, running, places, draining, held]


def _of_archive(session: Session, archive: Archive) -> list[Metric]:
    files = Metric("sms_archive_files", "Files of the archive that the catalogue knows, by what they are.")
    size = Metric("sms_archive_bytes", "Their size.")
    for source, count, total in session.execute(
        select(FileRow.source, func.count(), func.sum(FileRow.size_bytes))
        .group_by(FileRow.source)
        .order_by(FileRow.source)
    ):
        files.add(count, source=source)
        size.add(int(total), source=source)
    disk = archive.room()
    free = Metric("sms_archive_free_bytes", "Room left on the archive's disk.")
    free.add(disk.free_bytes)
    whole = Metric("sms_archive_disk_bytes", "Size of the archive's disk.")
    whole.add(disk.whole_bytes)
    return [files, size, free, whole]


def _of_schedules(session: Session, now: datetime) -> Metric:
    lag = Metric(
        "sms_schedule_lag_seconds", "By how much a schedule's first unfired time is overdue; 0 if none is."
    )
    last = (
        select(func.max(ScheduleFireRow.fire_time))
        .where(ScheduleFireRow.schedule_id == ScheduleRow.id)
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
        lag.add((now - due[0]).total_seconds() if due else 0.0, schedule=row.name)
    return lag


def as_text(metrics: Iterable[Metric]) -> str:
    """Return metrics in the text format that Prometheus and its relatives read, version 0.0.4."""
    lines = []
    for metric in metrics:
        lines += [f"# HELP {metric.name} {_escaped(metric.meaning)}", f"# TYPE {metric.name} gauge"]
        for labels, value in metric.samples:
            inner = ",".join(f'{name}="{_escaped(text, quoted=True)}"' for name, text in labels.items())
            lines.append(f"{metric.name}{{{inner}}} {value!r}" if inner else f"{metric.name} {value!r}")
    return "\n".join(lines) + "\n"


def _escaped(text: str, *, quoted: bool = False) -> str:
    escaped = text.replace("\\", r"\\").replace("\n", r"\n")
    return escaped.replace('"', r"\"") if quoted else escaped
