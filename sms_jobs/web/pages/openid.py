"""The way to an identity provider and back; what the way needs is kept by the browser that goes it."""

from __future__ import annotations

import json
from base64 import urlsafe_b64decode, urlsafe_b64encode
from dataclasses import asdict
from urllib.parse import quote, urlsplit

from fastapi import Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from sms_jobs.app.accounts import openid
from sms_jobs.app.accounts.openid import Journey
from sms_jobs.errors import NotAllowed
from sms_jobs.web.api import session
from sms_jobs.web.console import Pages, frame
from sms_jobs.web.pages.login import here
from sms_jobs.web.rendering import rendered

PAGES = Pages("openid")

_OUT, _BACK = "/login/openid", "/login/openid/back"
_KEPT = "sms_journey"
_MINUTES = 10
_PLAIN = "/?&=%+,:@"


@PAGES.router.get(_OUT)
def leave(request: Request, next: str = "/") -> Response:  # noqa: A002 - as the address calls it
    """Send the browser to the identity provider."""
    address, journey = openid.begin(session.of_nobody(request), _address_back(request))
    kept = json.dumps({"journey": asdict(journey), "next": here(next)}).encode()
    answer = RedirectResponse(address, 303)
    answer.set_cookie(
        _KEPT,
        urlsafe_b64encode(kept).decode(),
        max_age=60 * _MINUTES,
        path=_OUT,
        httponly=True,
        # The provider leads back here from its own site, with this cookie.
        samesite="lax",
        secure=request.app.state.secure,
    )
    return answer


@PAGES.router.get(_BACK)
def come_back(request: Request, state: str = "", code: str = "", error: str = "") -> Response:
    """Begin a session for whoever comes back, and go where they wanted to go."""
    if error:
        raise NotAllowed("the identity provider refused the log-in; try again")
    try:
        kept = json.loads(urlsafe_b64decode(request.cookies[_KEPT]))
        journey, going = Journey(**kept["journey"]), here(str(kept["next"]))
    except (KeyError, ValueError, TypeError) as wrong:
        raise NotAllowed(
            f"no log-in was started in this browser within the last {_MINUTES} minutes; start at /login"
        ) from wrong
    begun = openid.complete(session.of_nobody(request), journey, state, code)
    # Not a redirect: after one that began at another site, a browser would not send the session's cookie.
    page = rendered("came_back.html", **frame(request, None), going=going, name=begun.name)
    answer = HTMLResponse(page, headers={"Refresh": f"0; url={quote(going, safe=_PLAIN)}"})
    session.keep(request, answer, begun)
    answer.delete_cookie(_KEPT, path=_OUT)
    return answer


def _address_back(request: Request) -> str:
    scheme = "https" if request.app.state.secure else "http"
    return f"{scheme}://{urlsplit(str(request.url)).netloc}{_BACK}"
