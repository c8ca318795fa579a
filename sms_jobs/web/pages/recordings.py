"""Recordings: those that run or wait for an operator, what is planned, and what a campaign lacks."""

from __future__ import annotations

from fastapi.responses import HTMLResponse

from sms_jobs.app.measuring import last_frames, planned_recordings, quick_looks, recordings, rigs
from sms_jobs.app.specimens import campaigns
from sms_jobs.app.work import jobs
from sms_jobs.bootstrap import Services
from sms_jobs.errors import NotFound
from sms_jobs.records.job import JobState
from sms_jobs.records.optical_instruments import RigFile
from sms_jobs.records.shown.last_frames import LastFrame
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("recordings", Entry("Recordings", "/recordings", 30))

_KIND = "acquire"
_CHANGED = ("planned", "held")
"""Planned recordings that have not started, and may be held back or left out."""


@PAGES.show("/recordings", recordings.open_recordings)
def list_(page: Page, campaign: str = "") -> HTMLResponse:
    """Show what is recorded, what comes next, and what a campaign lacks."""
    services = page.services
    found = recordings.open_recordings(services)
    connected = rigs.list_rigs(services)
    plan = recordings.plan(services, campaign, missing=True) if campaign else None
    done = _last_recorded(services, campaign) if campaign else None
    planned = planned_recordings.show(services, campaign or None)
    looked_at = [campaign] if campaign else dict.fromkeys(one.campaign for one in planned)
    return page.render(
        "recordings.html",
        recordings=[(one, _frame(services, one.job_id)) for one in found],
        planned=planned,
        looks=[look for name in looked_at for look in quick_looks.show(services, name)],
        changed=_CHANGED,
        rigs=connected,
        devices=rigs.held_devices(services),
        campaigns=campaigns.names(services),
        campaign=campaign,
        plan=plan,
        channels=_channels(connected, plan.campaign.rig) if plan else (),
        progress=recordings.progress(services, campaign) if campaign else (),
        last=None if done is None else _frame(services, done),
        goes_on=(JobState.NEEDS_OPERATOR, JobState.FAILED),
        stops=(JobState.QUEUED, JobState.RUNNING),
    )


def _frame(services: Services, job: str) -> LastFrame | None:
    """Return the newest frame of a recording; None where this host has none, as when another one records."""
    try:
        return last_frames.last_frame(services, job)
    except NotFound:
        return None


def _last_recorded(services: Services, campaign: str) -> str | None:
    done = jobs.list_jobs(services, campaign=campaign, states=[JobState.SUCCEEDED], kind=_KIND, limit=1)
    return done[0].id if done else None


def _channels(connected: list[RigFile], rig: str) -> tuple[str, ...]:
    """Return the names of the channels of a rig; none where it is not connected to this host."""
    return tuple(channel.name for one in connected if one.name == rig for channel in one.serial.channels)
