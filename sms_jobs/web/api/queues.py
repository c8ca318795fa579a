"""Queues: what may begin, and in which order."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from sms_jobs.app.work import queues
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Campaign, Jobs, RequestBody, Text, Texts
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("queues")


class SomeQueues(RequestBody):
    """Queues by their names."""

    names: Annotated[Texts, Field(description="Empty for all.")]


class Pause(SomeQueues):
    """Queues to pause, and why."""

    reason: Annotated[Text, Field(description="Who asks why is told it or, if it is empty, who did it.")] = ""


class Ordered(RequestBody):
    """Jobs that are to come earlier or later: by their ids, or those of a campaign that are active."""

    jobs: Jobs
    campaign: Campaign = None


class Move(Ordered):
    """Jobs, and where they go."""

    to: Literal["front", "back"]


class Ranked(Ordered):
    """Jobs, and their priority."""

    value: Annotated[int, Field(description="Higher runs earlier.")]


@ROUTES.offer("GET", "/queues", queues.list_queues)
def list_queues(services: Acting) -> Any:
    """Return the queues."""
    return answer(queues.list_queues(services))


@ROUTES.offer("POST", "/queues/pause", queues.pause)
def pause(services: Acting, body: Pause) -> Any:
    """Pause queues."""
    return answer({"paused": queues.pause(services, body.names, body.reason)})


@ROUTES.offer("POST", "/queues/resume", queues.resume)
def resume(services: Acting, body: SomeQueues) -> Any:
    """Let queues go on."""
    return answer({"resumed": queues.resume(services, body.names)})


@ROUTES.offer("POST", "/queues/move", queues.move)
def move(services: Acting, body: Move) -> Any:
    """Bring jobs before or behind all others."""
    return answer({"moved": queues.move(services, body.jobs, body.campaign, body.to)})


@ROUTES.offer("POST", "/queues/priority", queues.set_priority)
def priority(services: Acting, body: Ranked) -> Any:
    """Give jobs another priority."""
    return answer({"changed": queues.set_priority(services, body.jobs, body.campaign, body.value)})
