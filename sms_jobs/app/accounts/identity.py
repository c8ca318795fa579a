"""Who asks, as whoever asks sees it."""

from __future__ import annotations

from dataclasses import dataclass

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.records.people import Right


@dataclass(frozen=True)
class Identity:
    """Who asks, and what they may do.

    Attributes
    ----------
    name, role
        Of the person.
    via
        How they came in: `web` by a session or from the desk, `token`, `command` or `python`.
    rights
        That the role has.
    """

    name: str
    role: str
    via: str
    rights: tuple[str, ...]


@use_case(Right.READ)
def who(services: Services) -> Identity:
    """Return who asks, and what they may do."""
    actor = services.actor
    role = "" if actor.role is None else actor.role.value
    return Identity(actor.name, role, actor.via, tuple(right.value for right in Right if actor.may(right)))
