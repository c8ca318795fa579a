"""The door: log in with name and password, log out, and the way back to the page that was asked for."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import parse_qs, urlsplit

from fastapi import Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import SecretStr, ValidationError

from sms_jobs.app.accounts import openid
from sms_jobs.errors import NotAllowed
from sms_jobs.web.api import session
from sms_jobs.web.console import LOGIN, Pages, frame
from sms_jobs.web.rendering import rendered

PAGES = Pages("login")


async def _form(request: Request) -> dict[str, str]:
    """Return what a plain form says; a field that is given twice counts once."""
    text = (await request.body()).decode("utf-8", "replace")
    return {name: values[0] for name, values in parse_qs(text, keep_blank_values=True).items()}


Form = Annotated[dict[str, str], Depends(_form)]


@PAGES.router.get(LOGIN)
def door(request: Request, next: str = "/") -> HTMLResponse:  # noqa: A002 - as the address calls it
    """Show the form."""
    return _shown(request, next)


@PAGES.router.post(LOGIN)
def log_in(request: Request, form: Form) -> Response:
    """Log in and go where somebody wanted to go; say so beside the name where that is refused."""
    name, back = form.get("name", ""), form.get("next", "/")
    try:
        begun = session.log_in(
            request, session.Credentials(name=name, password=SecretStr(form.get("password", "")))
        )
    except NotAllowed as error:
        return _shown(request, back, name, str(error), 403)
    except ValidationError:
        return _shown(request, back, name[:64], "the name or the password is too long, or no text", 422)
    answer = RedirectResponse(here(back), 303)
    answer.headers["Set-Cookie"] = begun.headers["Set-Cookie"]
    return answer


@PAGES.router.post("/logout")
def log_out(request: Request) -> Response:
    """End the session, and forget its cookie."""
    ended = session.log_out(request)
    answer = RedirectResponse(LOGIN, 303)
    answer.headers["Set-Cookie"] = ended.headers["Set-Cookie"]
    return answer


def _shown(request: Request, back: str, name: str = "", problem: str = "", status: int = 200) -> HTMLResponse:
    openid_offered = openid.is_offered(session.of_nobody(request))
    page = rendered(
        "login.html",
        **frame(request, None),
        next=here(back),
        name=name,
        problem=problem,
        openid_offered=openid_offered,
    )
    return HTMLResponse(page, status)


def here(address: str) -> str:
    """Return an address of this site; the start in place of any other."""
    try:
        parts = urlsplit(address)
    except ValueError:  # as of //[
        return "/"
    inside = not parts.scheme and not parts.netloc and address.startswith("/") and "\\" not in address
    return address if inside and not address.startswith(("//", LOGIN)) and address.isprintable() else "/"
