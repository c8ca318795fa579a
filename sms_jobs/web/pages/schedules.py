"""Schedules: what is submitted when, and what is coming, day by day."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import TypeAlias
from zoneinfo import ZoneInfo

from fastapi.responses import HTMLResponse

from sms_jobs.app.specimens import campaigns
from sms_jobs.app.work import kinds, schedules
from sms_jobs.records.shown.schedules import MOST_A_DAY, FiringsOfDay
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("schedules", Entry("Schedules", "/schedules", 60))

_COMING, _SHOWN = 20, 40
_WEEK = 7
_Week: TypeAlias = list["Day | None"]


@dataclass(frozen=True)
class Firing:
    """A time at which a schedule fires."""

    at: datetime
    schedule: str
    what: str


@dataclass(frozen=True)
class Day:
    """A day of the calendar, and what fires on it."""

    day: date
    firings: tuple[FiringsOfDay, ...]


@PAGES.show("/schedules", schedules.list_schedules)
def list_(page: Page, month: str = "", day: date | None = None, kind: str = kinds.EVERYTHING) -> HTMLResponse:
    """List the schedules and the coming firings; `kind` is that whose parameters can be given."""
    services, zone = page.services, schedules.local_zone()
    found = schedules.list_schedules(services)
    coming = [
        Firing(at, one.name, f"{', '.join(one.kinds)} of {one.campaign}")
        for one in found
        if not one.paused
        for at in schedules.coming(services, one.name, _COMING)
    ]
    here = ZoneInfo(zone)
    today = datetime.now(UTC).astimezone(here).date()
    first = schedules.month_of(month or (day or today).isoformat()[:7])
    offered = kinds.list_kinds(services)
    return page.render(
        "schedules.html",
        schedules=found,
        coming=sorted(coming, key=lambda firing: firing.at)[:_SHOWN],
        weeks=_weeks(first, schedules.calendar(services, f"{first:%Y-%m}", zone)),
        first=first,
        before=first - timedelta(days=1),
        after=first + timedelta(days=32),
        today=today,
        chosen=day,
        here=here,
        most=MOST_A_DAY,
        campaigns=campaigns.names(services),
        kinds=offered,
        kind=next((one for one in offered if one.name == kind), None),
        everything=kinds.EVERYTHING,
        zone=zone,
    )


def _weeks(first: date, found: Iterable[FiringsOfDay]) -> list[_Week]:
    """Return the weeks of a month, Monday first; None for days of other months."""
    firings = defaultdict(list)
    for one in found:
        firings[one.day].append(one)
    days: _Week = [None] * first.weekday()
    day = first
    while day.month == first.month:
        days.append(Day(day, tuple(firings[day])))
        day += timedelta(days=1)
    days += [None] * (-len(days) % _WEEK)
    return [days[k : k + _WEEK] for k in range(0, len(days), _WEEK)]
