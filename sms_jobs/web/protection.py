"""What keeps strangers out: whose pages may ask, how much, and what a browser may do with an answer."""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import urlsplit

import anyio
from fastapi import FastAPI, HTTPException
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sms_jobs.errors import InvalidInput, NotAllowed, SmsError
from sms_jobs.web.identity import COOKIE
from sms_jobs.web.refusals import TooLarge, refusal

_API = "/api/"
_NO_HEAD_OF_GET = re.compile(r"/api/v1/(events|data/\d+/file)")
"""What is told without end, and what may be endless and answers HEAD by itself."""
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_LARGEST_BODY = 16 << 20
_TOO_LARGE = f"the body is larger than {_LARGEST_BODY >> 20} MB; send it in chunks"
_TOO_SLOW = "the body of the request comes too slowly; send it in smaller chunks"
_RECEIVED_WITHIN_S = 30.0
_SLOWEST_BYTES_PER_S = 16 << 10
"""At which a body may come, beyond the time that any request has."""
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; font-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


@dataclass(frozen=True)
class Options:
    """Where and how the console is reached.

    Attributes
    ----------
    hosts
        Names by which it is asked for; a page of another name that leads here is refused. Empty for any.
    secure
        Whether it is reached by TLS alone, of its own or of a proxy before it.
    desk
        Whether whoever asks from this machine needs no name while nobody has one.
    """

    hosts: frozenset[str]
    secure: bool
    desk: bool


def install(app: FastAPI, options: Options) -> None:
    """Protect an application."""
    app.state.secure = options.secure
    app.add_middleware(_Protection, options=options)


class _Protection:
    def __init__(self, app: ASGIApp, options: Options) -> None:
        self._app = app
        self._options = options

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        head = scope["method"] == "HEAD" and _has_head_of_get(scope["path"])

        async def protected(message: Message) -> None:
            if head and message["type"] == "http.response.body":
                message = {**message, "body": b""}
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                if not scope["path"].startswith("/static/"):
                    headers.setdefault("Cache-Control", "no-store")
                if self._options.secure:
                    headers["Strict-Transport-Security"] = "max-age=31536000"
            await send(message)

        wrong = self._wrong(scope)
        if wrong is not None:
            await refusal(wrong)(scope, receive, protected)
            return
        asked = {**scope, "method": "GET"} if head else scope
        await self._app(asked, _Bounded(receive), protected)

    def _wrong(self, scope: Scope) -> SmsError | None:
        """Return why a request is not worked on; None where it is."""
        headers = Headers(scope=scope)
        try:
            host = urlsplit(f"//{headers.get('host', '')}").hostname or ""
            of_this_site = _of_this_site(headers)
        except ValueError:  # as of [
            return InvalidInput(
                "'Host' or 'Origin' of the request is no address; give localhost:8470 and http://localhost:8470"
            )
        if self._options.hosts and host not in self._options.hosts:
            return NotAllowed(f"nothing is served by the name {host!r:.80}; 'sms serve --host-name' adds one")
        if scope["method"] in _SAFE:
            return None
        if not of_this_site:
            return NotAllowed(
                "a page of another site asked for a change, or a program with the session of a browser; "
                "nothing was changed: programs come in with a token, which 'sms token create' gives"
            )
        if int(headers.get("content-length", "0") or 0) > _LARGEST_BODY:
            return TooLarge(_TOO_LARGE)
        return None


def _has_head_of_get(path: str) -> bool:
    return path.startswith(_API) and _NO_HEAD_OF_GET.fullmatch(path) is None


def _of_this_site(headers: Headers) -> bool:
    """Return whether a change is asked for by a page of this site, or by a program."""
    site = headers.get("sec-fetch-site")
    if site is not None and site not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    if origin is not None:
        return urlsplit(origin).netloc == headers.get("host")
    # A browser that says neither, with the cookie of a session, is not trusted.
    return site is not None or COOKIE not in headers.get("cookie", "")


class _Bounded:
    """Receives a body of at most so many bytes, whatever was announced, and in bounded time."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._left = _LARGEST_BODY
        self._until = anyio.current_time() + _RECEIVED_WITHIN_S
        self._whole = False

    async def __call__(self) -> Message:
        if self._whole:
            # What comes after the body is that the client has gone.
            return await self._receive()
        try:
            with anyio.fail_at(self._until):
                message = await self._receive()
        except TimeoutError:
            self._whole = True
            raise HTTPException(408, _TOO_SLOW) from None
        self._whole = not message.get("more_body", False)
        self._until += len(message.get("body", b"")) / _SLOWEST_BYTES_PER_S
        self._left -= len(message.get("body", b""))
        if self._left < 0:
            raise HTTPException(413, _TOO_LARGE)
        return message
