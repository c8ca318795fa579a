"""The audit: who did what, the newest first."""

from __future__ import annotations

from datetime import UTC, datetime, time
from typing import Annotated

from fastapi import Query
from fastapi.responses import HTMLResponse

from sms_jobs.app.accounts import audit
from sms_jobs.records.people import Right
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("audit", Entry("Audit", "/audit", 90, Right.ADMINISTER))


@PAGES.show("/audit", audit.list_links)
def list_(
    page: Page,
    who: str = "",
    action: str = "",
    since: str = "",
    after: Annotated[int | None, Query(ge=1, le=2**63 - 1)] = None,
    limit: Annotated[int, Query(ge=1, le=10_000)] = 100,
) -> HTMLResponse:
    """List what was done, of somebody, of an action, since a day, page by page."""
    links, problem = [], ""
    try:
        begun = datetime.combine(datetime.fromisoformat(since), time(), UTC) if since else None
        links = audit.list_links(
            page.services, who=who or None, action=action or None, since=begun, limit=limit, after=after
        )
    except ValueError:
        problem = f"'{since[:40]}' is no day; write it as 2026-05-04"
    return page.render(
        "audit.html",
        links=links,
        head=audit.head(page.services),
        problem=problem,
        who=who,
        action=action,
        since=since,
        after=after,
        limit=limit,
        more=len(links) == limit,
    )
