"""The archive: files found by what is known of them, and each with what it holds and comes from."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query
from fastapi.responses import HTMLResponse

from sms_jobs.app.holdings import archive, files, finding
from sms_jobs.app.specimens import campaigns
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.record_names import PICTURED, RecordName
from sms_jobs.records.shown.files import Page as Found
from sms_jobs.web.console import Entry, Page, Pages
from sms_jobs.web.lineage import drawn

PAGES = Pages("archive", Entry("Archive", "/archive", 50))


@PAGES.show("/archive", finding.find)
def find(
    page: Page,
    query: str = "",
    campaign: str = "",
    after: Annotated[int | None, Query(ge=1)] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 50,
) -> HTMLResponse:
    """Find files by a question, whose errors stand beside it."""
    services = page.services
    found, problem = Found((), (), None), ""
    try:
        question = finding.question(query, campaign=campaign or None)
        found = next(finding.find(services, question, finding.portion(None, after, limit)))
    except (InvalidInput, NotFound) as error:
        problem = str(error)
    return page.render(
        "archive.html",
        found=found,
        problem=problem,
        query=query,
        campaign=campaign,
        after=after,
        campaigns=campaigns.names(services),
        kept=finding.queries(services),
    )


@PAGES.show("/archive/state", archive.state)
def state(page: Page) -> HTMLResponse:
    """Show what was verified when, what is due, and what is damaged."""
    return page.render("archive_state.html", state=archive.state(page.services))


@PAGES.show("/archive/{key}", files.describe)
def show(page: Page, key: int) -> HTMLResponse:
    """Show a file: what it holds, its picture, and what it comes from."""
    services = page.services
    described = files.describe(services, str(key))
    return page.render(
        "file.html",
        file=described.file,
        described=described,
        pictured=any(RecordName.parse(name).name in PICTURED for name in described.records),
        lineage=drawn(files.tree(services, str(key))),
        down=files.tree(services, str(key), down=True).inputs,
    )
