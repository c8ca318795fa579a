"""Jobs: looked at and mended.

What only few of these need is imported there: of all commands, jobs are listed most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.asking import inquiry, standing
from sms_jobs.jobs.asking.inquiry import Event, JobView
from sms_jobs.jobs.planning import chosen
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.records.job import JobState
from sms_jobs.records.people import Right
from sms_jobs.records.shown.estimates import Outlook
from sms_jobs.records.shown.files import FileView


@use_case(Right.READ)
def list_jobs(
    services: Services,
    *,
    campaign: str | None = None,
    states: Sequence[JobState] = (),
    kind: str | None = None,
    limit: int = 50,
    after: str | None = None,
) -> list[JobView]:
    """Return jobs, the latest first; of a campaign, in some states, of a kind.

    Parameters
    ----------
    after
        Id of the last job that is known already.

    Raises
    ------
    NotFound
        There is no such campaign, or no such job.
    InvalidInput
        No job is of that kind, and none can be.
    """
    with services.catalogue.reading() as session:
        found = inquiry.list_jobs(
            session, campaign=campaign, states=states, kind=kind, limit=limit, after=after
        )
    if kind is not None and not found:
        # It loads every kind, for which those who ask for one that there is need not wait.
        from sms_jobs.kinds import kind_named

        kind_named(kind)
    return found


@dataclass(frozen=True)
class Remaining:
    """How many jobs have not ended, and how they come along; None where all have."""

    active: int
    outlook: Outlook | None


@use_case(Right.READ)
def remaining(services: Services, campaign: str | None = None) -> Remaining:
    """Return how the jobs of a campaign, or all, come along."""
    from sms_jobs.jobs.planning.estimates import outlook

    with services.catalogue.reading() as session:
        scope = chosen.of_campaign(session, campaign)
        active = standing.still_active(inquiry.counts(session, scope))
        return Remaining(active, outlook(session, scope, services.settings.workers) if active else None)


@dataclass(frozen=True)
class JobStory:
    """A job, what has happened to it, and the files that it made or took over."""

    job: JobView
    events: tuple[Event, ...]
    files: tuple[FileView, ...]


@use_case(Right.READ)
def show(services: Services, prefix: str) -> JobStory:
    """Return the job whose id begins so, with what became of it.

    Raises `NotFound` where there is none, and `Conflict` where there are several.
    """
    from sms_jobs.catalogue import search

    with services.catalogue.reading() as session:
        row = inquiry.find_job(session, prefix)
        files = search.files_of_job(session, row.reused_from or row.id)
        return JobStory(inquiry.job_view(row), tuple(inquiry.events(session, row.id)), tuple(files))


@dataclass(frozen=True)
class JobLog:
    """The log of a job, and where it lies; None where the job has written none."""

    job: JobView
    path: Path
    text: str | None


@use_case(Right.READ)
def log(services: Services, prefix: str) -> JobLog:
    """Return the log of the job whose id begins so, whichever host has run it; raises as `show` does."""
    from sms_jobs.jobs.running.logs import job_log

    with services.catalogue.reading() as session:
        view = inquiry.job_view(inquiry.find_job(session, prefix))
    path = job_log(services.settings.job_log_folder, view.id)
    there = path.exists()
    return JobLog(view, path, path.read_text("utf-8", errors="backslashreplace") if there else None)


@use_case(Right.READ)
def choose(services: Services, prefixes: Sequence[str], campaign: str | None) -> Chosen:
    """Choose the named jobs; if none is named, all active ones, or a campaign's.

    Raises `InvalidInput` where both are named, of which one would say nothing.
    """
    if prefixes and campaign is not None:
        raise InvalidInput(
            f"name jobs or a campaign, not both: {', '.join(prefixes[:3])} and `campaign` {campaign}"
        )
    with services.catalogue.reading() as session:
        if prefixes:
            return chosen.by_ids(inquiry.find_jobs(session, prefixes))
        return chosen.active_now(session, campaign)


@use_case(Right.COMPUTE)
def cancel(services: Services, prefixes: Sequence[str], campaign: str | None) -> int:
    """Cancel the named jobs, or those of a campaign, and return how many.

    Raises
    ------
    InvalidInput
        Neither is named.
    NotFound
        There is no such job or campaign.
    Conflict
        The named jobs have ended already.
    """
    from sms_jobs.jobs.running import crowds

    if not prefixes and campaign is None:
        raise InvalidInput("name the jobs to cancel, or a `campaign`")
    some = choose(services, prefixes, campaign)
    cancelled = crowds.cancel(services.catalogue, some, datetime.now(UTC), services.actor.name)
    if prefixes and not cancelled:
        raise Conflict("these jobs have ended already; nothing was cancelled")
    return cancelled


@use_case(Right.COMPUTE)
def retry(services: Services, prefixes: Sequence[str], campaign: str | None) -> int:
    """Give jobs that ended without success another chance, with all that was skipped for them.

    Returns how many run again. Raises as `cancel` does, `Conflict` for a job that cannot be retried.
    """
    from sms_jobs.jobs.running import crowds, orders

    if not prefixes and campaign is None:
        raise InvalidInput("name the jobs to retry, or a `campaign`")
    now, by = datetime.now(UTC), services.actor.name
    if campaign is not None and not prefixes:
        return crowds.retry(services.catalogue, campaign, now, by)
    with services.catalogue.writing() as session:
        ids = inquiry.find_jobs(session, prefixes)
        return sum(orders.retry(session, job_id, now, by) for job_id in ids)


@dataclass(frozen=True)
class Explanation:
    """Why a job waits, ran, was reused, or is stale, in sentences."""

    job_id: str
    sentences: tuple[str, ...]


@use_case(Right.READ)
def explain(services: Services, prefix: str) -> Explanation:
    """Say why a job waits, ran, was reused, or is stale; raises as `show` does."""
    from sms_jobs.jobs.asking import explanation

    with services.catalogue.reading() as session:
        row = inquiry.find_job(session, prefix)
        return Explanation(row.id, tuple(explanation.explain(session, row, datetime.now(UTC))))
