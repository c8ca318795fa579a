"""People: who has a name here, and how they come in."""

from __future__ import annotations

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import people
from sms_jobs.errors import NotAllowed
from sms_jobs.records.people import Actor, Right


@use_case(Right.READ)
def anybody(services: Services) -> bool:
    """Return whether anybody has a name here."""
    with services.catalogue.reading() as session:
        return people.anybody(session)


@use_case(Right.READ)
def actor_of(services: Services, secret: str, origin: str) -> Actor:
    """Return whose token or session it is; raises `NotAllowed` where it is nobody's."""
    raise NotAllowed("this token or session is nobody's")
