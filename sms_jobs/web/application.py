"""The application: the interface over HTTP, the console, and what protects both."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import import_module
from pkgutil import iter_modules

import anyio
import anyio.to_thread
from fastapi import FastAPI

import sms_jobs
from sms_jobs.bootstrap import Services
from sms_jobs.web import api, console, protection, refusals
from sms_jobs.web.following import Follower
from sms_jobs.web.long_work import AT_A_TIME
from sms_jobs.web.routes import Routes

API = "/api/v1"
_AT_A_TIME = 12
"""Requests that are worked on: fewer than the connections that a catalogue opens."""


def application(services: Services, options: protection.Options) -> FastAPI:
    """Return the application that serves a home.

    Parameters
    ----------
    services
        Of the home, in the name of the account that serves it.
    options
        Where and how it is reached.
    """

    @asynccontextmanager
    async def life(_app: FastAPI) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = _AT_A_TIME
        yield
        await anyio.to_thread.run_sync(follower.end)

    follower = Follower(services)
    app = FastAPI(
        title="sms_jobs",
        version=sms_jobs.__version__,
        openapi_url=f"{API}/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=life,
    )
    app.state.services = services
    app.state.desk = options.desk
    app.state.long_work = anyio.CapacityLimiter(AT_A_TIME)
    app.state.follower = follower
    refusals.install(app)
    for module in iter_modules(api.__path__):
        routes: Routes = import_module(f"{api.__name__}.{module.name}").ROUTES
        app.include_router(routes.router, prefix=API)
    console.install(app)
    protection.install(app, options)
    return app
