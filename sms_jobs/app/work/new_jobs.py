"""New jobs: what is to be computed, and what comes of asking for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import upkeep
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.asking import runs
from sms_jobs.jobs.planning import chosen
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.planning.estimates import estimate_planned
from sms_jobs.jobs.planning.graph import PIPELINE, Refused, Request, given_parameters
from sms_jobs.jobs.planning.refusals import check_jobs
from sms_jobs.jobs.planning.submission import Submission, Terms, draft, enter, while_outdated
from sms_jobs.jobs.planning.turns import planning_turn
from sms_jobs.records.people import Right
from sms_jobs.records.shown.estimates import Estimate
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
        A parameter, state or view is not one of them, or has no effect on a kind; a gauge lies outside of the
        images or off the surfaces that it is read from, a region has no pixel of its image, or the run cannot
        have that name.
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
