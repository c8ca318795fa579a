"""Recordings: those that run or wait for an operator, and what each campaign has still to record."""

from __future__ import annotations

from fastapi.responses import HTMLResponse

from sms_jobs.app import campaigns, recordings, rigs
from sms_jobs.records.job import JobState
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("recordings", Entry("Recordings", "/recordings", 30))


@PAGES.show("/recordings", recordings.open_recordings)
def list_(page: Page, campaign: str = "") -> HTMLResponse:
    """Show what is recorded, and what a campaign lacks."""
    services = page.services
    connected = rigs.list_rigs(services)
    return page.render(
        "recordings.html",
        recordings=recordings.open_recordings(services),
        rigs=connected,
        devices=rigs.held_devices(services),
        campaigns=campaigns.names(services),
        campaign=campaign,
        plan=recordings.plan(services, campaign, missing=True) if campaign else None,
        progress=recordings.progress(services, campaign) if campaign else (),
        goes_on=(JobState.NEEDS_OPERATOR, JobState.FAILED),
        stops=(JobState.QUEUED, JobState.RUNNING),
    )
