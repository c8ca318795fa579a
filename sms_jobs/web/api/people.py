"""People, and the tokens and sessions by which they come in."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Response
from pydantic import Field

from sms_jobs.app.accounts import people
from sms_jobs.app.accounts.people import NewToken
from sms_jobs.records.people import Role
from sms_jobs.records.shown.people import AccessView, PersonView
from sms_jobs.web.confirming import Password
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("people")

RoleName = Annotated[Role, Field(strict=False)]


class NewPerson(RequestBody):
    """Somebody who is to have a name here."""

    name: Text
    role: RoleName
    password: Annotated[Password | None, Field(description="None for the account of that name alone.")] = None


class ToRole(RequestBody):
    """What somebody is to be."""

    role: RoleName


class ToActive(RequestBody):
    """Whether somebody may come in."""

    active: bool


class NewPassword(RequestBody):
    """A password that is to hold from now on."""

    password: Password
    old: Annotated[Password | None, Field(description="Needed for one's own.")] = None


class NewAccess(RequestBody):
    """A token that is to be made for whoever asks."""

    label: Annotated[Text, Field(description="What it is for.")]
    days: Annotated[int, Field(ge=1, le=366)] = 90


@ROUTES.offer("GET", "/people", people.list_people, answers=list[PersonView])
def list_people(services: Acting) -> Any:
    """Return everybody who has a name here."""
    return answer(people.list_people(services))


@ROUTES.offer("POST", "/people", people.add, answers=PersonView, status=201)
def add(services: Acting, body: NewPerson) -> Any:
    """Give somebody a name."""
    return answer(people.add(services, body.name, body.role, body.password), 201)


@ROUTES.offer("POST", "/people/{name}/role", people.set_role, answers=PersonView)
def set_role(services: Acting, name: Name, body: ToRole) -> Any:
    """Let somebody do more or less."""
    return answer(people.set_role(services, name, body.role))


@ROUTES.offer("POST", "/people/{name}/active", people.set_active, answers=PersonView)
def set_active(services: Acting, name: Name, body: ToActive) -> Any:
    """Let somebody come in no more, or again."""
    return answer(people.set_active(services, name, body.active))


@ROUTES.offer("POST", "/people/{name}/password", people.set_password, status=204)
def set_password(services: Acting, name: Name, body: NewPassword) -> Response:
    """Give a person a password."""
    people.set_password(services, name, body.password, body.old)
    return Response(status_code=204)


@ROUTES.offer("GET", "/tokens", people.list_access, answers=list[AccessView])
def list_access(services: Acting, name: Text | None = None) -> Any:
    """Return the tokens and sessions of a person."""
    return answer(people.list_access(services, name))


@ROUTES.offer("POST", "/tokens", people.create_token, answers=NewToken, status=201)
def create_token(services: Acting, body: NewAccess) -> Any:
    """Make a token; its secret is shown this once."""
    return answer(people.create_token(services, body.label, body.days), 201)


@ROUTES.offer("DELETE", "/tokens/{access_id}", people.revoke, answers=AccessView)
def revoke(services: Acting, access_id: Name) -> Any:
    """Let a token or session let nobody in any more."""
    return answer(people.revoke(services, access_id))
