"""Connections over which a request has to come in time, and a server that ends whatever goes on.

Who sends the head of a request byte by byte is hung up on; who listens to events is told that they end.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from typing import Any, Final

import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from sms_jobs.records.texts import harmless

_log = logging.getLogger(__name__)

HEAD_WITHIN_S: Final = 10.0
"""In which the first line and the headers of a request have to be there."""
_KEPT_OPEN_S = 75
"""Somebody who reads a page for a while asks again on the same connection."""
_ENDS_WITHIN_S = 5
_TOO_SLOW = (
    b"HTTP/1.1 408 Request Timeout\r\nContent-Type: text/plain; charset=utf-8\r\nConnection: close\r\n\r\n"
    b"The headers of the request came too slowly."
)


class PromptProtocol(H11Protocol):
    """HTTP/1.1 as uvicorn has it, which bounds no more than the time between two requests.

    What comes after the head has bounds of its own (`protection`), as has the silence after an answer.
    """

    _head: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a first request."""
        super().connection_made(transport)
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Take what came; the time of a head begins with its first byte, and ends with its last."""
        super().data_received(data)
        if self.cycle is not None and not self.cycle.response_complete:
            self._stop_waiting()
        elif self._head is None:
            self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing any more."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _wait_for_head(self) -> None:
        self._head = self.loop.call_later(HEAD_WITHIN_S, self._hang_up)

    def _stop_waiting(self) -> None:
        if self._head is not None:
            self._head.cancel()
            self._head = None

    def _hang_up(self) -> None:
        # A browser that has only connected, to be quicker later, is told nothing.
        if self.conn.trailing_data[0]:
            self.transport.write(_TOO_SLOW)
        self.transport.close()


class PromptServer(uvicorn.Server):
    """Uvicorn's server, which waits for answers for some seconds when it ends, and says what it cuts off.

    Parameters
    ----------
    app
        What it serves.
    ending
        Called when it begins to end: has answers end that would go on for ever.
    options
        As for `uvicorn.Config`: where it is reached, and how.
    """

    def __init__(self, app: ASGIApp, ending: Callable[[], None], **options: Any) -> None:
        config = uvicorn.Config(
            _said_when_cut_off(app),
            http=PromptProtocol,
            access_log=False,
            server_header=False,
            log_config=None,
            timeout_graceful_shutdown=_ENDS_WITHIN_S,
            timeout_keep_alive=_KEPT_OPEN_S,
            **options,
        )
        super().__init__(config)
        self._ending = ending

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what goes on for ever, then wait for the rest."""
        self._ending()
        await super().shutdown(sockets)


def _said_when_cut_off(app: ASGIApp) -> ASGIApp:
    """Return an application that logs in one line which request was cancelled, and not what it was doing."""

    async def asked(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await app(scope, receive, send)
        except asyncio.CancelledError:
            if scope["type"] != "http":
                raise
            _log.warning("the answer to %s was cut off: the server ends", harmless(scope["path"]))

    return asked
