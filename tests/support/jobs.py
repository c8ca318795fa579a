"""Jobs of a small campaign, and how tests claim and look at them."""

from __future__ import annotations

from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, valid_calibrations
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning.graph import Existing, Request, plan
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.running import lifecycle
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.records.calibration import Acceptance
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.job import JobState
from sms_jobs.records.sensors import Calibration
from sms_jobs.virtual_rig.campaigns import small_plate

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
REQUESTS = [Request("simulate"), Request("pipeline")]


def _campaign(name: str) -> Campaign:
    return small_plate(name)[1]


JOBS = len(plan(_campaign("any"), REQUESTS, lambda need: Existing(file_id=1)))
"""Number of jobs of the whole campaign."""


def submit_pipeline(
    catalogue: Catalogue, name: str = "plate", priority: int = 0, fail_with: Exception | None = None
) -> tuple[str, ...]:
    """Add a campaign and submit all its jobs; the calibration they need is any file."""
    with catalogue.writing() as session:
        campaigns.add_campaign(session, _campaign(name), NOW)
        add_calibration_file(session, name)
        done = submit(session, name, REQUESTS, NOW, Terms(priority=priority))
        if fail_with is not None:
            raise fail_with
    return done.job_ids


def add_calibration_file(session: Session, name: str) -> None:
    """Index a calibration whose file nobody will open."""
    file = FileRow(
        source="calibration",
        path=f"calibrations/{name}.h5",
        content_hash=name,
        size_bytes=1,
        media_type="application/x-hdf5",
        created_at=NOW,
    )
    session.add(file)
    session.flush()
    accept_calibration(session, small_plate(name)[0], file.id)


def accept_calibration(session: Session, calibration: Calibration, file_id: int) -> None:
    """Index a calibration of some file, and use it for its rig by the decision of another."""
    number = valid_calibrations.add_calibration(session, calibration, file_id)
    decision = FileRow(
        source="acceptance",
        path=f"calibrations/acceptance-{file_id}.h5",
        content_hash="",
        size_bytes=1,
        media_type="application/x-hdf5",
        created_at=NOW,
    )
    session.add(decision)
    session.flush()
    valid_calibrations.decide(session, number, Acceptance(calibration.rig.name, ""), NOW, decision.id)


def claim(catalogue: Catalogue, now: datetime = NOW) -> Claim | None:
    """Claim the next job as worker `w1`."""
    with catalogue.writing() as session:
        return lifecycle.claim(session, ["cpu", "io", "acquisition"], "w1", 4711, now)


def state(catalogue: Catalogue, job_id: str) -> JobState:
    """Return the state of a job."""
    with catalogue.reading() as session:
        return session.get_one(JobRow, job_id).state


def events(catalogue: Catalogue, job_id: str) -> list[inquiry.Event]:
    """Return what has happened to a job."""
    with catalogue.reading() as session:
        return inquiry.events(session, job_id)


def ids(session: Session, job_id: str) -> list[str]:
    """Return the jobs that a job needs."""
    query = select(DependencyRow.producer_id).where(
        DependencyRow.job_id == job_id, DependencyRow.producer_id.is_not(None)
    )
    return [producer for producer in session.scalars(query) if producer is not None]


def add_event(session: Session, message: str) -> int:
    """Add an event of the first job that something happened to, and return its number."""
    job = session.scalars(select(EventRow.job_id).order_by(EventRow.id).limit(1)).one()
    row = EventRow(job_id=job, at=NOW, state=JobState.RUNNING, attempt=1, message=message)
    session.add(row)
    session.flush()
    return row.id
