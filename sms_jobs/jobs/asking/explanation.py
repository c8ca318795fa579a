"""Why a job stands where it does, in sentences."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import family
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow, QueueRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.running import empty_results
from sms_jobs.records.job import ALIVE_WITHIN, SHORT_ID, JobState
from sms_jobs.records.sizes import number_of


def explain(session: Session, job: JobRow, now: datetime) -> list[str]:
    """Say in sentences why a job stands where it does."""
    say = [f"{job.kind} {job.subject} is {job.state.value}" + (f": {job.message}" if job.message else "")]
    if job.state is JobState.WAITING:
        say += _why_waiting(session, job)
    elif job.state is JobState.QUEUED:
        say += _why_queued(session, job, now)
    elif job.state is JobState.RUNNING:
        say.append(f"it runs in process {job.pid} under worker {job.worker_id}, attempt {job.attempts}")
    elif job.state is JobState.SUCCEEDED:
        say += empty_results.explanations(session, job)
        say += _why_computed(session, job)
        say += _staleness(session, job, now)
    return say


def _why_waiting(session: Session, job: JobRow) -> list[str]:
    producers = session.scalars(
        select(JobRow)
        .join(DependencyRow, DependencyRow.producer_id == JobRow.id)
        .where(DependencyRow.job_id == job.id, JobRow.state != JobState.SUCCEEDED)
        .distinct()
    ).all()
    return [
        f"it needs {p.kind} {p.subject} (job {p.id[:SHORT_ID]}), which is {p.state.value}" for p in producers
    ]


def _why_queued(session: Session, job: JobRow, now: datetime) -> list[str]:
    ahead = session.execute(
        select(func.count()).where(
            JobRow.state == JobState.QUEUED,
            JobRow.queue == job.queue,
            (JobRow.priority > job.priority)
            | ((JobRow.priority == job.priority) & (JobRow.position < job.position)),
        )
    ).scalar_one()
    held_back = session.get(QueueRow, job.queue)
    if held_back is not None and held_back.paused_at is not None:
        hint = (
            "it goes on by itself" if held_back.for_room else f"'sms queue resume {job.queue}' lets it go on"
        )
        return [f"the queue '{job.queue}' is paused: {held_back.reason}; {hint}"]
    workers = session.scalars(select(WorkerRow).where(WorkerRow.draining.is_(False))).all()
    serving = [w for w in workers if job.queue in w.queues.split(",")]
    if not serving:
        return [f"no worker serves the queue '{job.queue}'; start one with 'sms up'"]
    alive = [w for w in serving if now - w.beat_at <= ALIVE_WITHIN]
    if alive and all(w.held_for is not None for w in alive):
        return [f"worker {w.id} claims no job: {w.held_for}; it goes on by itself" for w in alive]
    devices = [f"it needs {lock}" for lock in locks.waited_for(session, job.id, now)]
    before = f"{number_of(ahead, 'job')} of the queue '{job.queue}' {'comes' if ahead == 1 else 'come'}"
    return [*devices, f"{before} before it"]


def _why_computed(session: Session, job: JobRow) -> list[str]:
    if job.reused_from is not None:
        same = "same kind and version, parameters, inputs and definition"
        return [f"it was reused from job {job.reused_from[:SHORT_ID]}: {same}"]
    earlier = session.scalar(
        select(JobRow)
        .where(
            JobRow.kind == job.kind,
            JobRow.subject == job.subject,
            JobRow.state == JobState.SUCCEEDED,
            JobRow.reused_from.is_(None),
            JobRow.position < job.position,
        )
        .order_by(JobRow.position.desc())
        .limit(1)
    )
    if earlier is None:
        return ["it was computed: nothing like it had been before"]
    if not job.use_cache:
        return ["it was computed because reuse was switched off for it"]
    return [
        f"it was computed although job {earlier.id[:SHORT_ID]} is alike: {why}"
        for why in _changes(session, earlier, job)
    ]


def _changes(session: Session, earlier: JobRow, job: JobRow) -> list[str]:
    changes = []
    if earlier.kind_version != job.kind_version:
        changes.append(f"{job.kind} is now version {job.kind_version}, then {earlier.kind_version}")
    for name in sorted(earlier.parameters.keys() | job.parameters.keys()):
        then, now = earlier.parameters.get(name), job.parameters.get(name)
        if then != now:
            was, is_now = ("not given" if value is None else value for value in (then, now))
            changes.append(f"parameter {name} was {was}, now {is_now}")
    then_hashes, now_hashes = family.input_hashes(session, earlier.id), family.input_hashes(session, job.id)
    changes += [
        f"the content of its input '{role}' is another"
        for role in sorted(then_hashes.keys() | now_hashes.keys())
        if then_hashes.get(role) != now_hashes.get(role)
    ]
    return changes or [
        "what the campaign's definition says of it is another, or its files were gone or damaged"
    ]


def _staleness(session: Session, job: JobRow, now: datetime) -> list[str]:
    # What makes keys reads archives, which nobody who only lists jobs should wait for.
    from sms_jobs.jobs.results.stale import stale_files

    made = session.scalars(select(FileRow.id).where(FileRow.job_id == (job.reused_from or job.id))).all()
    stale = stale_files(session, session.get_one(CampaignRow, job.campaign_id), now) if made else {}
    return [f"it is stale: {why}" for why in dict.fromkeys(stale[n] for n in made if n in stale)]
