"""Who asks: a person by a token or by the session of a browser, or whoever sits at the desk."""

from __future__ import annotations

import ipaddress
from dataclasses import replace
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import APIKeyCookie, HTTPBearer

from sms_jobs.app.accounts import people
from sms_jobs.bootstrap import Services
from sms_jobs.errors import NotAllowed
from sms_jobs.web.refusals import NobodyKnown

COOKIE = "sms_session"
_TOKEN = HTTPBearer(
    scheme_name="token",
    auto_error=False,
    description="As `POST /tokens` and `sms token create` give it; it has the rights of a person.",
)
_SESSION = APIKeyCookie(
    name=COOKIE,
    scheme_name="session",
    auto_error=False,
    description="Of a browser, by `POST /session`; changes have to come from pages of this site.",
)
WAYS = (Depends(_TOKEN), Depends(_SESSION))
"""How people say who they are, for the description of an address; either will do."""


def services_for(request: Request) -> Services:
    """Return the services in the name of whoever asks; the same within a request.

    Raises
    ------
    NobodyKnown
        Nobody is logged in, or the token or session has ended.
    """
    known: Services | None = getattr(request.state, "services", None)
    if known is None:
        known = request.state.services = _services_for(request)
    return known


Acting = Annotated[Services, Depends(services_for)]
"""A parameter of an endpoint: the services in the name of whoever asks."""


def secret_of(request: Request) -> str | None:
    """Return the secret by which a request says who asks; None without one."""
    scheme, _, given = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and given:
        return given.strip()
    return request.cookies.get(COOKIE)


def origin_of(request: Request) -> str:
    """Return the network address that a request comes from."""
    return request.client.host if request.client is not None else ""


def _services_for(request: Request) -> Services:
    own: Services = request.app.state.services
    secret, origin = secret_of(request), origin_of(request)
    if secret is not None:
        try:
            return own.acting(people.actor_of(own, secret, origin))
        except NotAllowed as error:
            raise NobodyKnown(str(error)) from error
    if _at_the_desk(origin) and request.app.state.desk and not people.has_people(own):
        return own.acting(replace(own.actor, via="web", origin=origin))
    raise NobodyKnown(
        "you are not logged in; log in at /login, or send a token as 'Authorization: Bearer ...'"
    )


def _at_the_desk(origin: str) -> bool:
    try:
        return ipaddress.ip_address(origin).is_loopback
    except ValueError:
        return False
