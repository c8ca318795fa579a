"""Queues: what may begin, and in which order."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import Body

from sms_jobs.app.work import queues
from sms_jobs.web.identity import Acting
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("queues")

Names = Annotated[list[str], Body(description="Of queues; empty for all.")]
Jobs = Annotated[list[str], Body(description="Ids of jobs, or their beginnings.")]
Campaign = Annotated[str | None, Body(description="Instead of jobs: all of a campaign that are active.")]


@ROUTES.offer("GET", "/queues", queues.list_queues)
def list_queues(services: Acting) -> Any:
    """Return the queues."""
    return answer(queues.list_queues(services))


@ROUTES.offer("POST", "/queues/pause", queues.pause)
def pause(services: Acting, names: Names, reason: Annotated[str, Body()] = "paused by an operator") -> Any:
    """Pause queues."""
    return answer({"paused": queues.pause(services, names, reason)})


@ROUTES.offer("POST", "/queues/resume", queues.resume)
def resume(services: Acting, names: Annotated[list[str], Body(embed=True)]) -> Any:
    """Let queues go on."""
    return answer({"resumed": queues.resume(services, names)})


@ROUTES.offer("POST", "/queues/move", queues.move)
def move(
    services: Acting, to: Annotated[Literal["front", "back"], Body()], jobs: Jobs, campaign: Campaign = None
) -> Any:
    """Bring jobs before or behind all others."""
    return answer({"moved": queues.move(services, jobs, campaign, to)})


@ROUTES.offer("POST", "/queues/priority", queues.set_priority)
def priority(services: Acting, value: Annotated[int, Body()], jobs: Jobs, campaign: Campaign = None) -> Any:
    """Give jobs another priority."""
    return answer({"changed": queues.set_priority(services, jobs, campaign, value)})
