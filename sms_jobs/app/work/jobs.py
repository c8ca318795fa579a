"""Jobs: submitted, looked at and repaired."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search, upkeep
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.asking import explanation, inquiry, runs, standing
from sms_jobs.jobs.asking.inquiry import Event, JobView
from sms_jobs.jobs.planning import chosen
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.planning.estimates import estimate_planned, outlook
from sms_jobs.jobs.planning.graph import PIPELINE, Refused, Request, given_parameters
from sms_jobs.jobs.planning.refusals import check_jobs
from sms_jobs.jobs.planning.submission import Submission, Terms, draft, enter, while_outdated
from sms_jobs.jobs.planning.turns import planning_turn
from sms_jobs.jobs.running import crowds, orders
from sms_jobs.jobs.running.logs import job_log
from sms_jobs.records.job import JobState
from sms_jobs.records.people import Right
from sms_jobs.records.shown.estimates import Estimate, Outlook
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.subject import checked_name


@dataclass(frozen=True)
class Work:
    """What is to be computed of a campaign.

    Attributes
    ----------
    kinds
        Names of kinds, or `kinds.EVERYTHING`.
    parameters
        By `kind.name`; the name is enough where there is a single kind.
    states, views
        Empty for all.
    priority
        Higher runs earlier.
    use_cache
        Whether what was computed before is taken.
    run
        Name of the run that the results belong to, if any.
    """

    campaign: str
    kinds: tuple[str, ...]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    states: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    priority: int = 0
    use_cache: bool = True
    run: str | None = None

    @property
    def requests(self) -> list[Request]:
        """Each kind with its parameters; raises `InvalidInput` for a parameter of no kind."""
        kinds, parameters = self.kinds, self.parameters
        if len(kinds) == 1:
            own = {name.removeprefix(f"{kinds[0]}."): value for name, value in parameters.items()}
            return [Request(kinds[0], own, self.states, self.views)]
        stray = [name for name in parameters if name.partition(".")[0] not in kinds]
        if stray and PIPELINE not in kinds:
            raise InvalidInput(
                f"parameter '{stray[0]}' must be KIND.NAME=VALUE, with KIND one of {', '.join(kinds)}"
            )
        requests = []
        for kind in kinds:
            own = {name: value for name, value in parameters.items() if name.startswith(f"{kind}.")}
            given = {name.partition(".")[2]: value for name, value in own.items()}
            if kind == PIPELINE:
                given = {n: v for n, v in parameters.items() if n.partition(".")[0] not in kinds}
            requests.append(Request(kind, given, self.states, self.views))
        return requests


@dataclass(frozen=True)
class Refusal:
    """A state that is left out of a submission, or a job of the whole campaign.

    Attributes
    ----------
    subject
        As campaign/state, or the campaign.
    why
        What the first of its jobs lacks.
    jobs
        How many of its jobs are left out, by kind.
    """

    subject: str
    why: str
    jobs: dict[str, int]


@dataclass(frozen=True)
class Submitted:
    """Jobs that were submitted, or would be.

    Attributes
    ----------
    job_ids
        Each after those that it needs.
    counted
        How many of each kind.
    estimate
        When they will have ended.
    jobs
        What they are waited for by.
    refused
        States that are left out, with what needs their results: the others do not wait for them.
    """

    job_ids: tuple[str, ...]
    counted: dict[str, int]
    estimate: Estimate
    jobs: Chosen
    refused: tuple[Refusal, ...]

    @classmethod
    def from_server(
        cls,
        job_ids: Sequence[str],
        counted: dict[str, int],
        estimate: Estimate,
        refused: tuple[Refusal, ...],
    ) -> Submitted:
        """Return jobs that a server reports: they are known by their ids."""
        return cls(tuple(job_ids), counted, estimate, Chosen(tuple(job_ids)), refused)


@use_case(Right.COMPUTE)
def submit(services: Services, work: Work, *, dry_run: bool = False) -> Submitted:
    """Submit jobs and say how long they will take; with `dry_run`, say so alone.

    States whose jobs lack something are left out, and told with their reasons.

    Raises
    ------
    NotFound
        There is no such campaign or kind, or every state lacks something.
    InvalidInput
        A parameter, state or view is not one of them, a gauge lies outside of the images or off the surfaces
        that it is read from, a region has no pixel of its image, or the run cannot have that name.
    Conflict
        The run is kept as it is.
    """
    requests, now = work.requests, datetime.now(UTC)
    terms = Terms(work.priority, work.use_cache, services.actor.name)
    _check_run(services, work.run)

    def attempt() -> tuple[Submission, Estimate, tuple[Refused, ...]]:
        with services.catalogue.reading() as session:
            planned = draft(session, work.campaign, requests, now, terms)
            check_jobs(session, services.archive, work.campaign, planned.jobs)
            ahead = estimate_planned(session, planned, now, services.settings.workers)
        if dry_run:
            return planned.submission, ahead, planned.refused
        with services.catalogue.writing() as session:
            done = enter(session, planned)
            if work.run is not None and done.job_ids:
                runs.enter(session, work.run, done, given_parameters(requests), now, services.actor.name)
            return done, ahead, planned.refused

    with planning_turn(services.settings.home):
        done, ahead, refused = while_outdated(attempt)
    if not dry_run and len(done.job_ids) >= upkeep.MANY:
        upkeep.analyse(services.catalogue)
    counted = {name: done.kinds.count(name) for name in dict.fromkeys(done.kinds)}
    told = tuple(Refusal(str(one.subject), str(one.error), dict(one.jobs)) for one in refused)
    return Submitted(done.job_ids, counted, ahead, chosen.submitted(done), told)


def _check_run(services: Services, name: str | None) -> None:
    """Refuse a run that cannot take jobs before anything is planned for it."""
    if name is not None:
        checked_name(name, "run")
        with services.catalogue.reading() as session:
            runs.require_open(session, name)


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
    with services.catalogue.reading() as session:
        view = inquiry.job_view(inquiry.find_job(session, prefix))
    path = job_log(services.settings.job_log_folder, view.id)
    there = path.exists()
    return JobLog(view, path, path.read_text("utf-8", errors="backslashreplace") if there else None)


@use_case(Right.READ)
def choose(services: Services, prefixes: Sequence[str], campaign: str | None) -> Chosen:
    """Choose the named jobs; if none is named, all active ones, or a campaign's."""
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
    with services.catalogue.reading() as session:
        row = inquiry.find_job(session, prefix)
        return Explanation(row.id, tuple(explanation.explain(session, row, datetime.now(UTC))))
