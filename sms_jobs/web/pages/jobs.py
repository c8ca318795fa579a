"""Jobs: which there are, and the story of each."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query
from fastapi.responses import HTMLResponse

from sms_jobs.app.holdings import files
from sms_jobs.app.specimens import campaigns
from sms_jobs.app.work import jobs, kinds
from sms_jobs.records.job import ACTIVE, UNSUCCESSFUL, JobState
from sms_jobs.web.console import Entry, Page, Pages
from sms_jobs.web.lineage import drawn

PAGES = Pages("jobs", Entry("Jobs", "/jobs", 20))

_LONGEST_LOG = 200_000
"""Letters of a log that a page shows: its end."""


@PAGES.show("/jobs", jobs.list_jobs)
def list_(
    page: Page,
    states: Annotated[list[JobState], Query(default_factory=list)],
    campaign: str = "",
    kind: str = "",
    after: str = "",
    limit: Annotated[int, Query(ge=1, le=1000)] = 50,
) -> HTMLResponse:
    """List jobs, page by page."""
    services = page.services
    found = jobs.list_jobs(
        services,
        campaign=campaign or None,
        states=states,
        kind=kind or None,
        limit=limit,
        after=after or None,
    )
    return page.render(
        "jobs.html",
        jobs=found,
        campaigns=campaigns.names(services),
        kinds=kinds.list_kinds(services),
        all_states=list(JobState),
        states=states,
        campaign=campaign,
        kind=kind,
        after=after,
        limit=limit,
        more=len(found) == limit,
    )


@PAGES.show("/jobs/{job}", jobs.show)
def show(page: Page, job: str) -> HTMLResponse:
    """Tell the story of a job."""
    services = page.services
    story, told = jobs.show(services, job), jobs.log(services, job).text or ""
    state = JobState(story.job.state)
    return page.render(
        "job.html",
        story=story,
        job=story.job,
        explained=jobs.explain(services, job).sentences,
        log=told[-_LONGEST_LOG:],
        shortened=len(told) > _LONGEST_LOG,
        lineage=drawn(files.tree(services, str(story.files[0].id))) if story.files else None,
        can_cancel=state in ACTIVE or state in (JobState.QUARANTINED, JobState.NEEDS_OPERATOR),
        can_retry=state in UNSUCCESSFUL - {JobState.SKIPPED},
    )
