"""Schedules: jobs that are submitted at their time."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Annotated, Any, Literal

from fastapi import Query
from pydantic import Field

from sms_jobs.app.work import schedules
from sms_jobs.errors import InvalidInput
from sms_jobs.web.api.jobs import NewJobs
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer, returned

ROUTES = Routes("schedules")


class NewSchedule(NewJobs):
    """What is to be computed, and when: one of `cron`, `at`, `every` and `after`."""

    name: Text
    cron: Annotated[Text | None, Field(description="Minute, hour, day, month, weekday.")] = None
    at: Annotated[Text | None, Field(description="Once, at this time.")] = None
    every: Annotated[Text | None, Field(description="Again and again, after 30s, 10m, 2h or 1d.")] = None
    after: Annotated[Text | None, Field(description="Once, when this campaign is done.")] = None
    zone: Annotated[Text | None, Field(description="IANA time zone; the server's if not given.")] = None
    missed: Literal["skip", "once", "all"] = "once"
    grace: Annotated[float, Field(ge=1, le=1e7, description="Seconds until a time is missed.")] = 300.0

    @property
    def when(self) -> str:
        """When, as the use case takes it; raises `InvalidInput` unless one form is given."""
        forms = {"cron": self.cron, "at": self.at, "every": self.every, "after": self.after}
        given = [f"{form} {what}" for form, what in forms.items() if what is not None]
        if len(given) != 1:
            raise InvalidInput(f"give a time: one of cron, at, every and after, not {len(given)} of them")
        return given[0]


class Holding(RequestBody):
    """Whether a schedule is held back."""

    paused: bool


@dataclass(frozen=True)
class Scheduled:
    """A schedule that was made, and when it fires first; None where that follows from another campaign."""

    schedule: str
    next_fire: datetime | None


@ROUTES.offer("GET", "/schedules", schedules.list_schedules, answers=returned(schedules.list_schedules))
def list_schedules(services: Acting) -> Any:
    """Return the schedules."""
    return answer(schedules.list_schedules(services))


@ROUTES.offer("POST", "/schedules", schedules.add, answers=Scheduled, status=201)
def add(services: Acting, body: NewSchedule) -> Any:
    """Make a schedule."""
    first = schedules.add(
        services,
        body.name,
        body.when,
        body.work,
        zone=body.zone,
        missed=body.missed,
        grace=timedelta(seconds=body.grace),
    )
    return answer(Scheduled(body.name, first), 201)


@ROUTES.offer("GET", "/schedules/calendar", schedules.calendar, answers=returned(schedules.calendar))
def calendar(
    services: Acting,
    month: Annotated[Text | None, Query(description="As 2026-05; the present one if not given.")] = None,
    zone: Annotated[Text | None, Query(description="IANA time zone; the server's if not given.")] = None,
) -> Any:
    """Return what is coming in a month."""
    return answer(schedules.calendar(services, month, zone))


@ROUTES.offer("GET", "/schedules/{name}/coming", schedules.coming, answers=list[datetime])
def coming(services: Acting, name: Name, count: Annotated[int, Query(ge=1, le=1000)] = 5) -> Any:
    """Return when a schedule fires next."""
    return answer(schedules.coming(services, name, count))


@ROUTES.offer("POST", "/schedules/{name}/hold", schedules.set_paused, answers=dict[str, str | bool | int])
def hold(services: Acting, name: Name, body: Holding) -> Any:
    """Hold a schedule back, or let it go on."""
    schedules.set_paused(services, name, body.paused)
    return answer({"schedule": name, "paused": body.paused})


@ROUTES.offer("DELETE", "/schedules/{name}", schedules.remove, answers=dict[str, str | int])
def remove(services: Acting, name: Name) -> Any:
    """Remove a schedule."""
    schedules.remove(services, name)
    return answer({"removed": name})
