"""Jobs: submitted, looked at, waited for and repaired."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Any

import anyio
from anyio import to_thread
from fastapi import Query
from pydantic import Field

from sms_jobs.app.work import found_work, jobs, new_jobs, waiting
from sms_jobs.app.work.jobs import Explanation, JobStory, Remaining
from sms_jobs.app.work.new_jobs import Refusal, Submitted, Work
from sms_jobs.app.work.waiting import Waiting
from sms_jobs.bootstrap import Services
from sms_jobs.errors import WaitTimedOut
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.estimates import Estimate
from sms_jobs.records.shown.remarks import Remarks
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Campaign, Jobs, Limit, Name, Priority, RequestBody, Text, Texts
from sms_jobs.web.routes import Routes, answer, returned

ROUTES = Routes("jobs")

_LOOK_EVERY_S = 0.5
_LONGEST_WAIT_S = 55.0
"""Proxies give up after a minute."""


class Computation(RequestBody):
    """What is to be computed, whatever of."""

    kinds: Annotated[list[Text], Field(min_length=1, max_length=100)]
    parameters: Annotated[
        dict[str, Any], Field(description="By `kind.name`; the name is enough where there is a single kind.")
    ] = {}
    views: Annotated[Texts, Field(description="Empty for all.")] = []
    priority: Priority = 0
    use_cache: Annotated[bool, Field(description="Whether what was computed before is taken.")] = True
    run: Annotated[Text | None, Field(description="Name of the run that the results belong to.")] = None

    def work_of(self, campaign: str, states: list[str]) -> Work:
        """Return what the use case is given."""
        return Work(
            campaign,
            tuple(self.kinds),
            self.parameters,
            tuple(states),
            tuple(self.views),
            self.priority,
            self.use_cache,
            self.run,
        )


class NewJobs(Computation):
    """What is to be computed of a campaign."""

    campaign: Text
    states: Annotated[Texts, Field(description="Empty for all.")] = []

    @property
    def work(self) -> Work:
        """What the use case is given."""
        return self.work_of(self.campaign, self.states)


class Submission(NewJobs):
    """What is to be computed of a campaign, now."""

    dry_run: Annotated[bool, Field(description="Only say what would be submitted.")] = False


class FoundSubmission(Computation):
    """What is to be computed of the states that meet a question, now."""

    where: Annotated[Text, Field(description="In the language of `GET /data/states`.")]
    dry_run: Annotated[bool, Field(description="Only say what would be submitted.")] = False


class SomeJobs(RequestBody):
    """Jobs by their ids, or those of a campaign."""

    jobs: Jobs = []
    campaign: Campaign = None


@dataclass(frozen=True)
class SubmittedJobs:
    """Jobs that were submitted, or would be, how many of each kind, when they end, and what is left out."""

    campaign: str
    jobs: tuple[str, ...]
    counted: dict[str, int]
    estimate: Estimate
    refused: tuple[Refusal, ...]


@dataclass(frozen=True)
class SubmittedOfCampaigns:
    """What was submitted, or would be, of each campaign, and the campaigns that are left out."""

    campaigns: tuple[SubmittedJobs, ...]
    refused: tuple[Refusal, ...]


@dataclass(frozen=True)
class WaitAnswer:
    """How many jobs are in each state that are waited for; once all ended, why the last failed.

    With what those that succeeded remark about their data, by kind.
    """

    ended: bool
    jobs: dict[str, int]
    active: int
    failure: str
    remarks: tuple[Remarks, ...] = ()


@dataclass(frozen=True)
class LogAnswer:
    """The log of a job; None where it has written none."""

    job: str
    state: str
    text: str | None


@ROUTES.offer("GET", "/jobs", jobs.list_jobs, answers=returned(jobs.list_jobs))
def list_jobs(
    services: Acting,
    states: Annotated[
        list[JobState], Query(default_factory=list, description="May be repeated; all if not given.")
    ],
    campaign: Text | None = None,
    kind: Text | None = None,
    limit: Limit = 50,
    after: Annotated[Text | None, Query(description="Id of the last job that is known already.")] = None,
) -> Any:
    """Return jobs, the latest first."""
    found = jobs.list_jobs(services, campaign=campaign, states=states, kind=kind, limit=limit, after=after)
    return answer(found)


@ROUTES.offer("POST", "/jobs", new_jobs.submit, answers=SubmittedJobs)
def submit(services: Acting, body: Submission) -> Any:
    """Submit jobs, or say what would be submitted."""
    return answer(_told(body.campaign, new_jobs.submit(services, body.work, dry_run=body.dry_run)))


@ROUTES.offer("POST", "/jobs/found", found_work.submit_found, answers=SubmittedOfCampaigns)
def submit_found(services: Acting, body: FoundSubmission) -> Any:
    """Submit jobs for the states that meet a question, across campaigns."""
    done = found_work.submit_found(services, body.where, body.work_of("", []), dry_run=body.dry_run)
    told = tuple(_told(name, one) for name, one in done.campaigns.items())
    return answer(SubmittedOfCampaigns(told, done.refused))


def _told(campaign: str, done: Submitted) -> SubmittedJobs:
    return SubmittedJobs(campaign, done.job_ids, done.counted, done.estimate, done.refused)


@ROUTES.offer("GET", "/jobs/remaining", jobs.remaining, answers=Remaining)
def remaining(services: Acting, campaign: Text | None = None) -> Any:
    """Return how jobs come along."""
    return answer(jobs.remaining(services, campaign))


@ROUTES.offer("GET", "/jobs/wait", waiting.wait_for, answers=WaitAnswer)
async def wait(
    services: Acting,
    job: Annotated[list[Text], Query(default_factory=list, description="Ids, or their beginnings.")],
    campaign: Text | None = None,
    seconds: Annotated[float, Query(ge=0, le=_LONGEST_WAIT_S, allow_inf_nan=False)] = 30.0,
) -> Any:
    """Return how jobs stand once they have ended, or after so many seconds; then ask again."""
    some = await to_thread.run_sync(jobs.choose, services, job, campaign)
    deadline = time.monotonic() + seconds
    while True:
        began = time.monotonic()
        found = await to_thread.run_sync(_look, services, some)
        now = time.monotonic()
        if found.ended or now >= deadline:
            return answer(found)
        # No thread is held meanwhile, however many wait.
        await anyio.sleep(min(max(_LOOK_EVERY_S, 10 * (now - began)), deadline - now))


def _look(services: Services, some: Any) -> WaitAnswer:
    looked: list[Waiting] = []
    try:
        waited = waiting.wait_for(services, some, 0.0, looked.append)
    except WaitTimedOut:
        return WaitAnswer(False, looked[-1].counted, looked[-1].active, "")
    return WaitAnswer(True, waited.counted, 0, waited.failure, waited.remarks)


@ROUTES.offer("POST", "/jobs/cancel", jobs.cancel, answers=dict[str, int])
def cancel(services: Acting, body: SomeJobs) -> Any:
    """Cancel jobs."""
    return answer({"cancelled": jobs.cancel(services, body.jobs, body.campaign)})


@ROUTES.offer("POST", "/jobs/retry", jobs.retry, answers=dict[str, int])
def retry(services: Acting, body: SomeJobs) -> Any:
    """Give jobs another chance."""
    return answer({"retried": jobs.retry(services, body.jobs, body.campaign)})


@ROUTES.offer("GET", "/jobs/{job}", jobs.show, answers=JobStory)
def show(services: Acting, job: Name) -> Any:
    """Return a job with what became of it."""
    return answer(jobs.show(services, job))


@ROUTES.offer("GET", "/jobs/{job}/log", jobs.log, answers=LogAnswer)
def log(services: Acting, job: Name) -> Any:
    """Return the log of a job."""
    found = jobs.log(services, job)
    return answer(LogAnswer(found.job.id, found.job.state, found.text))


@ROUTES.offer("GET", "/jobs/{job}/explain", jobs.explain, answers=Explanation)
def explain(services: Acting, job: Name) -> Any:
    """Say why a job stands where it does."""
    return answer(jobs.explain(services, job))
