"""The application, served and asked within the process of a test."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import uvicorn
from fastapi import FastAPI
from starlette.types import ASGIApp, Receive, Scope, Send

from sms_jobs.bootstrap import Services
from sms_jobs.web.application import application
from sms_jobs.web.protection import Options

DESK = ("127.0.0.1", 50_000)
API = "/api/v1"


def at_the_desk(app: ASGIApp) -> ASGIApp:
    """Return an application as whoever sits at its machine sees it."""

    async def asked(scope: Scope, receive: Receive, send: Send) -> None:
        await app({**scope, "client": DESK} if scope["type"] == "http" else scope, receive, send)

    return asked


def app_of(services: Services) -> FastAPI:
    """Return the application of a home, for whoever sits at its machine."""
    return application(services, Options(frozenset(), secure=False, desk=True))


@contextmanager
def served(app: FastAPI) -> Iterator[httpx.Client]:
    """Serve an application on a port of its own, to a client at its machine."""
    server = uvicorn.Server(
        uvicorn.Config(app, port=0, log_config=None, access_log=False, timeout_graceful_shutdown=1)
    )
    thread = threading.Thread(target=server.run, name="server")
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        with httpx.Client(base_url=f"http://127.0.0.1:{port}{API}", timeout=30.0) as client:
            yield client
    finally:
        server.should_exit = True
        thread.join(30.0)
