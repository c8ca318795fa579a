"""Connections over which a request has to come in time, and a server that waits for none that never ends.

Who sends the head of a request byte by byte is hung up on; who listens to events is told that they end.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Final

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_WITHIN_S: Final = 10.0
"""In which the first line and the headers of a request have to be there."""
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
    """Uvicorn's server, which waits for answers when it ends: also for those that go on for ever.

    Parameters
    ----------
    config
        As for uvicorn.
    ending
        Called when it begins to end: has such answers end.
    """

    def __init__(self, config: uvicorn.Config, ending: Callable[[], None]) -> None:
        super().__init__(config)
        self._ending = ending

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what goes on for ever, then wait for the rest."""
        self._ending()
        await super().shutdown(sockets)
