"""Named runs: shown, kept, dropped and compared."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Query
from fastapi.responses import Response

from sms_jobs.app.work import run_comparison, runs
from sms_jobs.records.shown.runs import RunComparison, RunStory, RunView
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("runs")

_HTML = "text/html"


class Kept(RequestBody):
    """Why a run is kept."""

    reason: Text = ""


@ROUTES.offer("GET", "/runs", runs.list_runs, answers=list[RunView])
def list_runs(services: Acting) -> Any:
    """Return the runs, the newest first."""
    return answer(runs.list_runs(services))


@ROUTES.offer("GET", "/runs/{name}", runs.show, answers=RunStory)
def show(services: Acting, name: Name) -> Any:
    """Return a run with the results that it names."""
    return answer(runs.show(services, name))


@ROUTES.offer("GET", "/runs/{name}/compare", run_comparison.compare_runs, answers=RunComparison)
def compare(
    services: Acting, name: Name, other: Annotated[Text, Query(alias="with", description="The later run.")]
) -> Any:
    """Return what was not the same in two runs, and by how much their results differ."""
    return answer(run_comparison.compare_runs(services, name, other))


@ROUTES.offer("GET", "/runs/{name}/compare/page", run_comparison.compare_runs_page, media=(_HTML,))
def compare_page(
    services: Acting, name: Name, other: Annotated[Text, Query(alias="with", description="The later run.")]
) -> Any:
    """Return the same as a page with maps, to be kept."""
    page = run_comparison.compare_runs_page(services, name, other)
    headers = {"Content-Disposition": 'attachment; filename="runs.html"'}
    return Response(page.html, media_type=f"{_HTML}; charset=utf-8", headers=headers)


@ROUTES.offer("POST", "/runs/{name}/keep", runs.keep, answers=RunStory)
def keep(services: Acting, name: Name, body: Kept) -> Any:
    """Keep what a run names, and add nothing to it."""
    return answer(runs.keep(services, name, body.reason))


@ROUTES.offer("DELETE", "/runs/{name}", runs.drop, answers=dict[str, str | int])
def drop(services: Acting, name: Name) -> Any:
    """Forget the name of a run."""
    runs.drop(services, name)
    return answer({"dropped": name})
