"""The application, served and asked within the process of a test."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx2
from fastapi import FastAPI

from sms_jobs.bootstrap import Services
from sms_jobs.web.application import application
from sms_jobs.web.connections import PromptServer
from sms_jobs.web.protection import Options

API = "/api/v1"


def app_of(services: Services) -> FastAPI:
    """Return the application of a home, for whoever sits at its machine."""
    return application(services, Options(frozenset(), secure=False, desk=True))


@contextmanager
def served(app: FastAPI) -> Iterator[httpx2.Client]:
    """Serve an application on a port of its own, to a client at its machine."""
    server = PromptServer(app, app.state.follower.dismiss, port=0)
    thread = threading.Thread(target=server.run, name="server")
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        with httpx2.Client(base_url=f"http://127.0.0.1:{port}{API}", timeout=30.0) as client:
            yield client
    finally:
        server.should_exit = True
        thread.join(30.0)


BEATS = 6
"""After so many signs of life, 15 s apart, a test waits no longer for an event."""


@contextmanager
def listening(client: httpx2.Client, **options: Any) -> Iterator[Iterator[dict[str, str]]]:
    """Listen to events; each is its fields."""
    with client.stream("GET", "events", **options) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = answer.iter_lines()
        assert next(lines).startswith(":")

        def events() -> Iterator[dict[str, str]]:
            fields: dict[str, str] = {}
            beats = 0
            for line in lines:
                name, _, value = line.partition(": ")
                if line.startswith(":"):
                    beats += 1
                    assert beats < BEATS, f"{beats} signs of life, and nothing was told"
                elif line:
                    fields[name] = value
                elif "data" in fields:
                    yield fields
                    fields, beats = {}, 0

        yield events()
