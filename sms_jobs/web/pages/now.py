"""What goes on: queues, jobs that run, workers, rigs, disk, and what waits for a person."""

from __future__ import annotations

from fastapi.responses import HTMLResponse

from sms_jobs.app.home import service
from sms_jobs.app.measuring import recordings, rigs
from sms_jobs.app.work import jobs, queues
from sms_jobs.records.job import JobState
from sms_jobs.web.api import home
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("now", Entry("Now", "/", 0))

_MOST = 20
_FOR_A_PERSON = (JobState.NEEDS_OPERATOR, JobState.QUARANTINED, JobState.FAILED)


@PAGES.show("/", service.status)
def now(page: Page) -> HTMLResponse:
    """Show what goes on."""
    services = page.services
    return page.render(
        "now.html",
        status=home.status_of(services),
        queues=queues.list_queues(services),
        running=jobs.list_jobs(services, states=[JobState.RUNNING], limit=_MOST),
        asking=jobs.list_jobs(services, states=_FOR_A_PERSON, limit=_MOST),
        open_recordings=recordings.open_recordings(services),
        rigs=rigs.list_rigs(services),
        devices=rigs.held_devices(services),
        most=_MOST,
    )
