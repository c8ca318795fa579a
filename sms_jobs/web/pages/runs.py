"""Named runs: which there are, what each names, and what differs between two."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query
from fastapi.responses import HTMLResponse

from sms_jobs.app.work import run_comparison, runs
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("runs", Entry("Runs", "/runs", 25))

_SHOWN = 500

Limit = Annotated[int, Query(ge=1, le=100_000)]


@PAGES.show("/runs", runs.list_runs)
def list_(page: Page) -> HTMLResponse:
    """List the runs."""
    return page.render("runs.html", runs=runs.list_runs(page.services))


@PAGES.show("/runs/{name}", runs.show)
def show(page: Page, name: str, limit: Limit = _SHOWN) -> HTMLResponse:
    """Show what a run names, and with which others it can be compared."""
    services = page.services
    return page.render(
        "run.html",
        story=runs.show(services, name),
        others=[one.name for one in runs.list_runs(services) if one.name != name],
        limit=limit,
    )


@PAGES.show("/runs/{name}/compare", run_comparison.compare_runs)
def compare(
    page: Page, name: str, other: Annotated[str, Query(alias="with")] = "", limit: Limit = _SHOWN
) -> HTMLResponse:
    """Show what was not the same in two runs, and by how much their results differ."""
    found = run_comparison.compare_runs(page.services, name, other)
    return page.render("run_comparison.html", found=found, limit=limit)
