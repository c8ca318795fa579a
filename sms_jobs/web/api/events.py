"""Events: what happens to jobs, planned recordings, calibrations and schedules, told as it happens."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator
from contextlib import aclosing, suppress
from typing import Annotated, Any, cast

import anyio
from anyio import to_thread
from fastapi import Header, Query, Request
from fastapi.responses import StreamingResponse
from starlette.types import Message, Send

from sms_jobs.app.work import happenings
from sms_jobs.app.work.happenings import Cursor, Happening, News
from sms_jobs.bootstrap import Services
from sms_jobs.errors import NotAllowed, ServerUnreachable, SmsError
from sms_jobs.records.people import Right
from sms_jobs.records.plain import plain
from sms_jobs.records.shown.changes import Change
from sms_jobs.web import identity
from sms_jobs.web.following import Follower, Listener, Told
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Text
from sms_jobs.web.routes import Routes

ROUTES = Routes("events")

_BEAT_S = 15.0
_KNOWN_FOR_S = 60.0
_AWAY_S = 2.0
_LONGEST_SEND_S = 30.0
_BEAT = b": beat\n\n"


@ROUTES.offer("GET", "/events", happenings.happened, media=("text/event-stream",))
async def events(
    request: Request,
    services: Acting,
    campaign: Annotated[
        Text | None, Query(description="Only what is about it, and what is about none alone.")
    ] = None,
    last_event_id: Annotated[
        str | None,
        Header(pattern=r"^\d{1,18}(-\d{1,18})?$", description="Go on after it; from now on if not given."),
    ] = None,
) -> Any:
    """Tell what happens, until the connection is closed."""
    headers = {"X-Accel-Buffering": "no"}  # a proxy that waits for more would tell nothing for minutes
    after = None if last_event_id is None else Cursor.parse(last_event_id)
    told = _told(request, services, campaign, after)
    return _Stream(_written(told), media_type="text/event-stream", headers=headers)


async def _told(
    request: Request, services: Services, campaign: str | None, after: Cursor | None
) -> AsyncGenerator[Told | None, None]:
    """Yield what happened, each with where to go on after it; None where nothing has for a while.

    Whoever has heard anything is told all that happens from then on, unless the catalogue is away.
    """
    follower: Follower = request.app.state.follower
    listener = Listener(asyncio.get_running_loop())
    try:
        while (safe := await _listened(follower, listener)) is None:
            yield None
        yield None
        recent: set[tuple[str, int]] = set()
        while after is not None:
            page = await _asked(services, after)
            if page is None:
                yield None
                continue
            for cursor, one in page.placed(_lower(after, safe), safe):
                if one.number > (safe.jobs if isinstance(one, Happening) else safe.changes):
                    recent.add(_key(one))
                if _is_about(one, campaign):
                    yield cursor, one
            after = _end(page, after) if happenings.is_full(page) else None
        async for told in _live(request, listener):
            known = told is None or _key(told[1]) in recent or not _is_about(told[1], campaign)
            yield None if known else told
    finally:
        follower.leave(listener)


def _lower(one: Cursor, other: Cursor) -> Cursor:
    return Cursor(min(one.jobs, other.jobs), min(one.changes, other.changes))


def _end(page: News, after: Cursor) -> Cursor:
    """Return the last numbers of a page that was asked for after others."""
    jobs = page.jobs[-1].number if page.jobs else after.jobs
    return Cursor(jobs, page.changes[-1].number if page.changes else after.changes)


def _event(one: Happening | Change) -> str:
    """Return the name of an event: what has changed."""
    return "job" if isinstance(one, Happening) else one.topic


def _key(one: Happening | Change) -> tuple[str, int]:
    """Return by what an event is told apart from all others."""
    return ("job" if isinstance(one, Happening) else "change", one.number)


def _is_about(one: Happening | Change, campaign: str | None) -> bool:
    """Return whether an event concerns a campaign; what is about no one campaign may concern any."""
    return campaign is None or one.campaign in ("", campaign)


async def _live(request: Request, listener: Listener) -> AsyncGenerator[Told | None, None]:
    """Yield what a listener is told as long as whoever asks may listen; nothing where nothing happens."""
    known_until = anyio.current_time() + _KNOWN_FOR_S
    while not listener.dropped:
        news = await listener.next(_BEAT_S)
        for told in news:
            yield told
        if not news:
            yield None
        if anyio.current_time() >= known_until:
            if not await to_thread.run_sync(_still_known, request):
                return
            known_until = anyio.current_time() + _KNOWN_FOR_S


def _still_known(request: Request) -> bool:
    """Return whether the token or session by which somebody listens still lets them in."""
    request.state.services = None
    try:
        services = identity.services_for(request)
        return services.actor.may(Right.READ)
    except NotAllowed:
        return False
    except SmsError:
        return True  # the catalogue is away; it is asked again


async def _listened(follower: Follower, listener: Listener) -> Cursor | None:
    """Let somebody listen, and return after which numbers all is told; None while it is away."""
    try:
        return await to_thread.run_sync(follower.listen, listener)
    except ServerUnreachable:
        await anyio.sleep(_AWAY_S)
        return None


async def _asked(services: Services, after: Cursor) -> News | None:
    """Return what happened after some numbers; None, after a moment, while the catalogue is away."""
    try:
        return await to_thread.run_sync(happenings.happened, services, after)
    except ServerUnreachable:
        await anyio.sleep(_AWAY_S)
        return None


async def _written(
    told: AsyncGenerator[Told | None, None],
) -> AsyncGenerator[bytes, None]:
    """Yield events as they are sent, and a sign of life where nothing else has been for a while."""
    sent_at = -_BEAT_S
    async with aclosing(told):
        async for one in told:
            now = anyio.current_time()
            if one is not None:
                cursor, happened = one
                data = json.dumps(plain(happened), ensure_ascii=False)
                yield f"id: {cursor}\nevent: {_event(happened)}\ndata: {data}\n\n".encode()
            elif now - sent_at >= _BEAT_S:
                yield _BEAT
            else:
                continue
            sent_at = now


class _Stream(StreamingResponse):
    """A stream that is given up when whoever asked for it does not read."""

    async def stream_response(self, send: Send) -> None:
        """Send what there is, as long as it is taken."""

        async def sending(message: Message) -> None:
            with anyio.fail_after(_LONGEST_SEND_S):
                await send(message)

        with suppress(TimeoutError):
            async with aclosing(cast(AsyncGenerator[bytes, None], self.body_iterator)):
                await super().stream_response(sending)
