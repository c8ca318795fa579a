"""The home: how it stands, who works for it, what it can compute, and the schema of its catalogue."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi.responses import Response
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from pydantic import Field

from sms_jobs.app.home import database, service
from sms_jobs.app.home.database import Compared
from sms_jobs.app.home.service import Status
from sms_jobs.app.work import kinds
from sms_jobs.app.work.kinds import KindView
from sms_jobs.bootstrap import Services
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import RequestBody, Text
from sms_jobs.web.routes import Routes, answer, returned
from sms_jobs.web.sharing import Shared

ROUTES = Routes("home")


_STATUS: Shared[Status] = Shared()


def status_of(services: Services) -> Status:
    """Return how the home stands, or stood a moment ago, for everybody who asks."""
    return _STATUS.of(services.settings.home, lambda: service.status(services))


@ROUTES.offer("GET", "/status", service.status, answers=Status)
def status(services: Acting) -> Any:
    """Return how the home stands."""
    return answer(status_of(services))


@ROUTES.offer("GET", "/workers", service.workers, answers=returned(service.workers))
def workers(services: Acting) -> Any:
    """Return the workers."""
    return answer(service.workers(services))


@ROUTES.offer("GET", "/metrics", service.metrics, media=[CONTENT_TYPE_PLAIN_0_0_4])
def metrics(services: Acting) -> Response:
    """Return the numbers that monitoring reads, as Prometheus writes them."""
    return Response(service.metrics(services), media_type=CONTENT_TYPE_PLAIN_0_0_4)


class Drained(RequestBody):
    """Which worker is to end."""

    worker: Annotated[Text, Field(description="Beginning of its id.")]


@ROUTES.offer("POST", "/workers/drain", service.drain, answers=dict[str, int | str])
def drain(services: Acting, body: Drained) -> Any:
    """Let a worker finish what it runs."""
    return answer({"draining": service.drain(services, body.worker)})


@ROUTES.offer("GET", "/kinds", kinds.list_kinds, answers=list[KindView])
def list_kinds(services: Acting) -> Any:
    """Return the job kinds."""
    return answer(kinds.list_kinds(services))


@ROUTES.offer("GET", "/database", database.check, answers=Compared)
def check(services: Acting) -> Any:
    """Compare the catalogue's schema with what is needed."""
    return answer(database.check(services))
