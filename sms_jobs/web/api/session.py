"""The session of a browser: started with a password, ended, and whose it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from typing import Annotated, Any

from fastapi import Request, Response
from fastapi.responses import JSONResponse
from pydantic import Field

from sms_jobs.app.accounts import identity as identities
from sms_jobs.app.accounts import people
from sms_jobs.app.accounts.identity import Identity
from sms_jobs.app.accounts.people import LoggedIn
from sms_jobs.bootstrap import Services
from sms_jobs.records.people import ANONYMOUS
from sms_jobs.web.confirming import Password
from sms_jobs.web.identity import COOKIE, Acting, origin_of
from sms_jobs.web.request_bodies import RequestBody, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("session")


class Credentials(RequestBody):
    """Who logs in."""

    name: Text
    password: Annotated[Password, Field(description="Of that person.")]


@dataclass(frozen=True)
class SessionBegun:
    """Whose session it is, and when it ends at the latest; its secret is in the cookie alone."""

    name: str
    role: str
    expires_at: datetime


@ROUTES.offer("POST", "/session", people.log_in, answers=SessionBegun)
def log_in(request: Request, body: Credentials) -> Any:
    """Log in, and get the cookie of a session."""
    done = people.log_in(of_nobody(request), body.name, body.password)
    response = answer(SessionBegun(done.name, done.role.value, done.expires_at))
    keep(request, response, done)
    return response


@ROUTES.offer("DELETE", "/session", people.log_out, status=204)
def log_out(request: Request) -> Response:
    """Log out: end the session of the cookie, and forget it."""
    secret = request.cookies.get(COOKIE)
    if secret is not None:
        people.log_out(of_nobody(request), secret)
    response = Response(status_code=204)
    response.delete_cookie(
        COOKIE, path="/", httponly=True, samesite="strict", secure=request.app.state.secure
    )
    return response


@ROUTES.offer("GET", "/session", identities.who, answers=Identity)
def who(services: Acting) -> JSONResponse:
    """Say who asks, and what they may do."""
    return answer(identities.who(services))


def keep(request: Request, response: Response, session: LoggedIn) -> None:
    """Let the browser keep a session that was started."""
    response.set_cookie(
        COOKIE,
        session.secret,
        expires=session.expires_at,
        path="/",
        httponly=True,
        samesite="strict",
        secure=request.app.state.secure,
    )


def of_nobody(request: Request) -> Services:
    """Return the services in the name of somebody who has not said who it is yet."""
    own: Services = request.app.state.services
    return own.acting(replace(ANONYMOUS, origin=origin_of(request)))
