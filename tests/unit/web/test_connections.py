"""A server that ends while somebody waits for an answer."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
import time

import pytest
from starlette.types import Receive, Scope, Send

from sms_jobs.web import connections
from sms_jobs.web.connections import PromptServer


async def endless(scope: Scope, receive: Receive, send: Send) -> None:
    """Begin an answer, and never end it."""
    if scope["type"] == "lifespan":
        for _ in range(2):
            event = await receive()
            await send({"type": f"{event['type']}.complete"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"begun", "more_body": True})
    await asyncio.Event().wait()


def test_what_is_cut_off_is_said_in_a_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "_ENDS_WITHIN_S", 0.2)
    ended: list[str] = []
    server = PromptServer(endless, lambda: ended.append("told"), port=0)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    with socket.create_connection(server.servers[0].sockets[0].getsockname(), timeout=30.0) as waiting:
        waiting.sendall(b"GET /wait%1B HTTP/1.1\r\nHost: here\r\n\r\n")
        answer = b""
        while b"begun" not in answer:
            answer += waiting.recv(4096)
        server.should_exit = True
        assert waiting.recv(4096) == b""
    thread.join(30.0)
    assert not thread.is_alive()
    assert ended == ["told"]
    said = [one for one in caplog.records if one.levelno >= logging.WARNING]
    assert "the answer to /wait\\x1b was cut off: the server ends" in [one.getMessage() for one in said]
    assert not any(one.exc_info for one in said)
