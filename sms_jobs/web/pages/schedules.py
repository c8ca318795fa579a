"""Schedules: what is submitted when, and what is coming."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from fastapi.responses import HTMLResponse

from sms_jobs.app import campaigns, kinds, schedules
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("schedules", Entry("Schedules", "/schedules", 60))

_COMING, _SHOWN = 20, 40


@dataclass(frozen=True)
class Firing:
    """A time at which a schedule fires."""

    at: datetime
    schedule: str
    what: str


@PAGES.show("/schedules", schedules.list_schedules)
def list_(page: Page) -> HTMLResponse:
    """List the schedules and the coming firings."""
    services = page.services
    found = schedules.list_schedules(services)
    coming = [
        Firing(at, one.name, f"{', '.join(one.kinds)} of {one.campaign}")
        for one in found
        if not one.paused
        for at in schedules.coming(services, one.name, _COMING)
    ]
    return page.render(
        "schedules.html",
        schedules=found,
        coming=sorted(coming, key=lambda firing: firing.at)[:_SHOWN],
        campaigns=campaigns.names(services),
        kinds=kinds.list_kinds(services),
        everything=kinds.EVERYTHING,
        zone=schedules.local_zone(),
    )
