"""Schedules: jobs that are submitted at their time."""

from __future__ import annotations

import re
import time
from calendar import monthrange
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.jobs.planning.refusals import check_requests
from sms_jobs.jobs.scheduling import schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression, zone_named
from sms_jobs.jobs.scheduling.schedules import MissedFire, Order, ScheduleView
from sms_jobs.records.people import Right
from sms_jobs.records.shown.schedules import FiringsOfDay

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

_MONTH = re.compile(r"2[01]\d\d-(0[1-9]|1[0-2])")


@use_case(Right.RECORD)
def add(
    services: Services,
    name: str,
    when: str,
    work: Work,
    *,
    zone: str | None = None,
    missed: MissedFire = "once",
    grace: timedelta = timedelta(minutes=5),
    where: str | None = None,
) -> datetime | None:
    """Submit work at a time, again and again, or when another campaign is done; return the first time.

    Results of work that names a run belong to it; what fires again and again has a run for each time, with
    the time in UTC at the end of its name.

    Parameters
    ----------
    when
        A form and what belongs to it: "cron 0 2 * * *", "at 2026-05-04T10:00", "every 2h", "after panel".
    zone
        IANA time zone of the times; this machine's if it is None.
    missed
        What becomes of times that passed with no service running.
    grace
        After which a time counts as missed.
    where
        Instead of the campaign and states of the work, those that meet this question when it fires.

    Raises
    ------
    InvalidInput
        The time or the work cannot be understood, no view of the campaign can read a gauge, or a region has
        no pixel of its image.
    NotFound
        There is no such campaign or kind.
    Conflict
        There is a schedule of that name.
    """
    expression = parse_expression(when, zone or local_zone())
    if where is not None and (work.campaign or work.states):
        raise InvalidInput("states come from the question; leave out the campaign and the states")
    requests = tuple(work.requests)
    order = Order(work.campaign, requests, work.priority, work.use_cache, work.run, where)
    now = datetime.now(UTC)
    with services.catalogue.reading() as session:
        _refuse_what_fails(services, session, order)
    schedules.add(services.catalogue, name, expression, order, now, missed_fire=missed, grace=grace)
    with services.catalogue.reading() as session:
        return schedules.first_fire(session, name, now)


def _refuse_what_fails(services: Services, session: Session, order: Order) -> None:
    """Refuse an order that could only fail as its campaigns are now; of several one is enough to do."""
    errors = []
    found = schedules.campaigns_of(session, order)
    for campaign, states in found.items():
        asked = [replace(one, states=states) for one in order.requests] if states else order.requests
        try:
            check_requests(session, services.archive, campaign, asked)
        except (InvalidInput, NotFound) as error:
            errors.append(error)
    if len(errors) == len(found):
        raise errors[0]


@use_case(Right.READ)
def list_schedules(services: Services) -> list[ScheduleView]:
    """Return the schedules, what became of them last, and when they fire next."""
    with services.catalogue.reading() as session:
        return schedules.schedules(session, datetime.now(UTC))


@use_case(Right.READ)
def coming(services: Services, name: str, count: int) -> list[datetime]:
    """Return the next times of a schedule; raises `NotFound` where there is none of that name."""
    with services.catalogue.reading() as session:
        return schedules.coming(session, name, datetime.now(UTC), count)


@use_case(Right.READ)
def calendar(services: Services, month: str | None = None, zone: str | None = None) -> list[FiringsOfDay]:
    """Return what is coming in a month, a line for each day and schedule.

    Parameters
    ----------
    month
        As 2026-05; the present one if it is None.
    zone
        IANA time zone of the days; this machine's if it is None.

    Raises `InvalidInput` for what is no month or no zone.
    """
    where = zone_named(zone or local_zone())
    now = datetime.now(UTC)
    first = month_of(month or f"{now.astimezone(where):%Y-%m}")
    with services.catalogue.reading() as session:
        return schedules.calendar(session, first, monthrange(first.year, first.month)[1], where, now)


def month_of(text: str) -> date:
    """Return the first day of a month that is written as 2026-05; raise `InvalidInput` for anything else."""
    if _MONTH.fullmatch(text) is None:
        raise InvalidInput(f"'{text}' is no month from 2000 to 2199; write it as 2026-05")
    return date.fromisoformat(f"{text}-01")


@use_case(Right.RECORD)
def set_paused(services: Services, name: str, paused: bool) -> None:
    """Hold a schedule back, or let it go on; times that passed meanwhile count as missed."""
    with services.catalogue.writing() as session:
        schedules.set_paused(session, name, paused)


@use_case(Right.RECORD)
def remove(services: Services, name: str) -> None:
    """Remove a schedule; jobs that it submitted stay."""
    with services.catalogue.writing() as session:
        schedules.remove(session, name)


def local_zone() -> str:
    """Return the IANA name of this machine's zone; UTC where the machine does not tell it."""
    link = Path("/etc/localtime")
    _, found, name = str(link.resolve()).partition("zoneinfo/") if link.is_symlink() else ("", "", "")
    if found and time.localtime().tm_zone not in ("", "UTC"):
        return name
    return "UTC"
