"""People, their tokens and sessions."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from sms_jobs.app import people
from sms_jobs.app.people import NewToken
from sms_jobs.records.people import Role
from sms_jobs.records.shown.people import AccessView, PersonView
from sms_jobs.web.asked import Asked, Name, Text
from sms_jobs.web.confirming import Password, Reason
from sms_jobs.web.identity import Acting
from sms_jobs.web.routes import Routes, answer, returned

ROUTES = Routes("people")

GivenRole = Annotated[Role, Field(strict=False)]


class NewPerson(Asked):
    """Somebody who is to have a name here."""

    name: Text
    role: GivenRole
    password: Password | None = None


class NewRole(Asked):
    """What somebody may do from now on."""

    role: GivenRole


class NewPassword(Asked):
    """A password for somebody."""

    password: Password


class OwnPassword(Asked):
    """One's own new password, and the one until now."""

    password: Password
    old: Password


class Active(Asked):
    """Whether somebody may come in, and why."""

    active: bool
    reason: Reason = ""


class WantedToken(Asked):
    """What a token is for, and how long it lasts."""

    label: Text
    days: Annotated[int, Field(ge=1, le=people.LONGEST_TOKEN_DAYS)] = 90


@ROUTES.offer("GET", "/people", people.list_people, answers=returned(people.list_people))
def list_people(services: Acting) -> Any:
    """Return everybody."""
    return answer(people.list_people(services))


@ROUTES.offer("POST", "/people", people.add, answers=PersonView, status=201)
def add(services: Acting, body: NewPerson) -> Any:
    """Give somebody a name."""
    return answer(people.add(services, body.name, body.role, body.password), 201)


@ROUTES.offer("POST", "/people/{name}/role", people.set_role, answers=PersonView)
def set_role(services: Acting, name: Name, body: NewRole) -> Any:
    """Let somebody do more or less."""
    return answer(people.set_role(services, name, body.role))


@ROUTES.offer("POST", "/people/{name}/active", people.set_active, answers=PersonView)
def set_active(services: Acting, name: Name, body: Active) -> Any:
    """Let somebody come in no more, or again."""
    return answer(people.set_active(services.because(body.reason), name, body.active))


@ROUTES.offer("POST", "/people/{name}/password", people.set_password, answers=dict[str, int | str])
def set_password(services: Acting, name: Name, body: NewPassword) -> Any:
    """Give somebody a password."""
    people.set_password(services, name, body.password)
    return answer({"name": name})


@ROUTES.offer("POST", "/account/password", people.set_password, answers=dict[str, int | str])
def own_password(services: Acting, body: OwnPassword) -> Any:
    """Give oneself another password."""
    people.set_password(services, services.actor.name, body.password, body.old)
    return answer({"name": services.actor.name})


@ROUTES.offer("GET", "/access", people.list_access, answers=returned(people.list_access))
def list_access(services: Acting) -> Any:
    """Return one's own tokens and sessions."""
    return answer(people.list_access(services))


@ROUTES.offer("POST", "/tokens", people.create_token, answers=NewToken, status=201)
def create_token(services: Acting, body: WantedToken) -> Any:
    """Make a token; its secret is told this once."""
    return answer(people.create_token(services, body.label, body.days), 201)


@ROUTES.offer("POST", "/access/{access}/revoke", people.revoke, answers=AccessView)
def revoke(services: Acting, access: Name) -> Any:
    """Let a token or session let nobody in any more."""
    return answer(people.revoke(services, access))
