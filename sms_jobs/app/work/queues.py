"""Queues: what may begin, and in which order."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Literal

from sqlalchemy.orm import Session

from sms_jobs.app.rules import use_case
from sms_jobs.app.work import jobs
from sms_jobs.bootstrap import Services
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.running import queues as held
from sms_jobs.jobs.running.queues import QueueView
from sms_jobs.records.people import Right


@use_case(Right.READ)
def list_queues(services: Services) -> list[QueueView]:
    """Return the queues, how many jobs are in them, and which are paused."""
    with services.catalogue.reading() as session:
        return held.queues(session)


@use_case(Right.RECORD)
def pause(services: Services, names: Sequence[str], reason: str) -> list[str]:
    """Let no more jobs of some queues begin, or of all if none is named; return which.

    Whoever asks why is told the reason or, if that is empty, who did it.

    Raises `InvalidInput` for a queue that is not there.
    """
    with services.catalogue.writing() as session:
        selected = _checked(session, names)
        for name in selected:
            held.pause(session, name, reason or f"paused by {services.actor.name}", datetime.now(UTC))
    return selected


@use_case(Right.RECORD)
def resume(services: Services, names: Sequence[str]) -> list[str]:
    """Let the jobs of paused queues begin again, of all if none is named; return which were paused.

    Raises `InvalidInput` for a queue that is not there, and `Conflict` where none of the named was paused.
    """
    with services.catalogue.writing() as session:
        selected = _checked(session, names)
        resumed = [name for name in selected if held.resume(session, name)]
    if names and not resumed:
        raise Conflict(f"{', '.join(selected)} was not paused; nothing was changed")
    return resumed


@use_case(Right.COMPUTE)
def move(
    services: Services, prefixes: Sequence[str], campaign: str | None, to: Literal["front", "back"]
) -> int:
    """Bring the named jobs, or those of a campaign, that have not started before or behind all others.

    Returns how many. Raises as `jobs.choose` does, and `InvalidInput` where neither is named.
    """
    some = _named(services, prefixes, campaign)
    with services.catalogue.writing() as session:
        return held.move(session, some, to)


@use_case(Right.COMPUTE)
def set_priority(services: Services, prefixes: Sequence[str], campaign: str | None, priority: int) -> int:
    """Give the named jobs, or those of a campaign, that have not started another priority; return how many.

    Raises
    ------
    InvalidInput
        Neither is named, or the priority is beyond what is kept.
    Conflict
        They have all started or ended.
    """
    if abs(priority) > held.HIGHEST_PRIORITY:
        raise InvalidInput(
            f"a priority of {priority} is beyond +-{held.HIGHEST_PRIORITY}; give one between these"
        )
    some = _named(services, prefixes, campaign)
    with services.catalogue.writing() as session:
        count = held.set_priority(session, some, priority)
    if not count:
        raise Conflict("these jobs have already started or ended; nothing was changed")
    return count


def _checked(session: Session, names: Sequence[str]) -> list[str]:
    existing = held.queue_names(session)
    unknown = [name for name in names if name not in existing]
    if unknown:
        raise InvalidInput(f"there is no queue '{unknown[0]}'; choose among {', '.join(existing)}")
    return list(names) or existing


def _named(services: Services, prefixes: Sequence[str], campaign: str | None) -> Chosen:
    if not prefixes and campaign is None:
        raise InvalidInput("name the jobs, or a `campaign`")
    return jobs.choose(services, prefixes, campaign)
