"""The console: pages that the server makes of use cases, each with the rule of what it shows."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pkgutil import iter_modules
from typing import Annotated, Any, Final
from urllib.parse import quote

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.exceptions import HTTPException
from starlette.staticfiles import StaticFiles

from sms_jobs.app import assets
from sms_jobs.app.rules import Rule, require, rule_of
from sms_jobs.app.work import happenings
from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.records.people import Right
from sms_jobs.web import identity, pacing, refusals
from sms_jobs.web.following import Follower
from sms_jobs.web.identity import COOKIE
from sms_jobs.web.rendering import rendered

LOGIN: Final = "/login"
PAGE_RULES: dict[str, Rule] = {}
"""Rule of each page, by its path."""
_API = "/api/"


@dataclass(frozen=True)
class Entry:
    """A line of the menu.

    Attributes
    ----------
    name, path
        What it says, and where it leads.
    place
        Smaller stands earlier.
    right
        Of whoever is shown it.
    """

    name: str
    path: str
    place: int
    right: Right = Right.READ


_MENU: list[Entry] = []


class Pages:
    """The pages of one subject."""

    def __init__(self, name: str, menu: Entry | None = None) -> None:
        self.router = APIRouter(include_in_schema=False)
        self.name = name
        if menu is not None:
            _MENU.append(menu)
            _MENU.sort(key=lambda entry: entry.place)

    def show(self, path: str, use_case: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
        """Show what a use case returns at a path; whoever may not call it is refused before.

        Parameters
        ----------
        path
            From the root of the site.
        use_case
            With a rule.
        """
        rule = rule_of(use_case)
        if rule is None:
            raise TypeError(f"{use_case} has no rule")
        PAGE_RULES[path] = rule

        def permitted(request: Request) -> None:
            require(identity.services_for(request), Rule(rule.name, rule.right))

        return self.router.get(path, response_class=HTMLResponse, dependencies=[Depends(permitted)])


class PageRequest:
    """A page that somebody asked for.

    Attributes
    ----------
    services
        In the name of whoever asks.
    """

    def __init__(self, request: Request) -> None:
        self._begun = time.monotonic()
        self.services: Services = identity.services_for(request)
        self._request = request
        # Taken before anything is read for the page: what happens from then on is told to it.
        self._heard_until = (
            str(happenings.newest(self.services)) if self.services.actor.may(Right.READ) else ""
        )

    def render(self, template: str, **shown: Any) -> HTMLResponse:
        """Return the page that a template makes of what is shown."""
        given = frame(self._request, self.services, self._heard_until)
        made = rendered(template, **given, **shown)
        follower: Follower = self._request.app.state.follower
        rest = pacing.rest_s(time.monotonic() - self._begun, follower.listeners)
        return HTMLResponse(made, headers={pacing.REST_HEADER: f"{1e3 * rest:.0f}"})


Page = Annotated[PageRequest, Depends(PageRequest)]
"""A parameter of an endpoint: the page that was asked for."""


def frame(request: Request, services: Services | None, heard_until: str = "") -> dict[str, Any]:
    """Return what every template is given: who asks, what that may do, the menu, and where this is.

    Parameters
    ----------
    heard_until
        Of which event a page knows, so that it follows those after it; empty for those from now on.
    """
    actor = None if services is None else services.actor

    def may(right: str) -> bool:
        return actor is not None and actor.may(Right(right))

    return {
        "actor": actor,
        "may": may,
        "menu": [entry for entry in _MENU if actor is not None and actor.may(entry.right)],
        "path": request.url.path,
        "session": COOKIE in request.cookies,
        "heard_until": heard_until,
    }


def back_to(request: Request) -> str:
    """Return the log-in page that leads back to where a request was going."""
    query = f"?{request.url.query}" if request.url.query else ""
    return f"{LOGIN}?next={quote(request.url.path + query, safe='')}"


class _Files(StaticFiles):
    """Scripts and styles, which a browser asks for again after an upgrade."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        """Return a file, or that it has not changed."""
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response


def subjects() -> list[Pages]:
    """Return the pages of every subject."""
    from sms_jobs.web import pages

    return [import_module(f"{pages.__name__}.{one.name}").PAGES for one in iter_modules(pages.__path__)]


def install(app: FastAPI) -> None:
    """Add the pages to an application, and let them say what is wrong as pages."""
    for found in subjects():
        app.include_router(found.router)

    @app.get("/static/look.css", include_in_schema=False)
    def look() -> Response:
        return Response(assets.style(), media_type="text/css", headers={"Cache-Control": "no-cache"})

    app.mount("/static", _Files(packages=[("sms_jobs.web", "static")]))
    for kind in (SmsError, RequestValidationError, HTTPException):
        app.add_exception_handler(kind, _as_page(app.exception_handlers[kind]))


def _as_page(plain: Callable[[Request, Any], Any]) -> Callable[[Request, Any], Any]:
    """Answer an error of a page with a page, where programs are answered in JSON."""

    def refuse(request: Request, error: Exception) -> Response:
        if request.url.path.startswith(_API):
            answer: Response = plain(request, error)
            return answer
        if isinstance(error, refusals.NobodyKnown):
            return RedirectResponse(back_to(request), 303)
        return _refusal(request, error)

    return refuse


def _refusal(request: Request, error: Exception) -> Response:
    if isinstance(error, SmsError):
        status, words = refusals.status_of(error), str(error)
    elif isinstance(error, HTTPException):
        status, words = (
            error.status_code,
            f"there is no page {request.url.path}; the menu shows those there are",
        )
    else:
        status, words = 422, "the address of this page has a value that cannot be used; begin from the menu"
    try:
        services = identity.services_for(request)
    except SmsError:
        services = None
    return HTMLResponse(
        rendered("refused.html", **frame(request, services), words=words, status=status), status
    )
