"""The audit: who did what."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Query

from sms_jobs.app.accounts import audit
from sms_jobs.records.shown.people import Link
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Limit, Moment, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("audit")


@ROUTES.offer("GET", "/audit", audit.list_links, answers=list[Link])
def list_links(
    services: Acting,
    who: Annotated[Text | None, Query(description="Only by this person, account or schedule.")] = None,
    action: Annotated[
        Text | None, Query(description="Only this use case, as jobs.cancel, or all of a group, as jobs.")
    ] = None,
    since: Annotated[Moment | None, Query(description="With zone; only from then on.")] = None,
    limit: Limit = 50,
    after: Annotated[
        int | None, Query(ge=1, le=2**63 - 1, description="Number of the last link that is known already.")
    ] = None,
) -> Any:
    """Return what was done, the newest first."""
    found = audit.list_links(services, who=who, action=action, since=since, limit=limit, after=after)
    return answer(found)
