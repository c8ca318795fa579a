"""Files and load states are found, and questions kept."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Annotated, Any

from fastapi import Query
from pydantic import Field

from sms_jobs.app.holdings import finding
from sms_jobs.app.holdings.finding import Question
from sms_jobs.app.holdings.finding_states import find_states
from sms_jobs.bootstrap import Services
from sms_jobs.records.shown.states import FoundState
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer, returned

ROUTES = Routes("find")

Limit = Annotated[int, Query(ge=1, le=1000, description="Of a page.")]
After = Annotated[int | None, Query(ge=1, le=2**63 - 1, description="`next` of the page before.")]
Columns = Annotated[
    Text | None,
    Query(description="What to tell of each file, with commas between; else what is compared."),
]


class NewQuery(RequestBody):
    """A query and its name."""

    name: Text
    text: Annotated[str, Field(max_length=10_000)]
    replace: bool = False


@dataclass(frozen=True)
class FoundPage:
    """Some files, the newest first.

    Attributes
    ----------
    columns, times
        Names of the values, and those of them that are times.
    files
        Each as `/data/{key}` has it, and its `values`.
    next
        What to go on after; None on the last page.
    """

    columns: tuple[str, ...]
    times: tuple[str, ...]
    files: list[dict[str, Any]]
    next: int | None


@ROUTES.offer("GET", "/data/find", finding.find, answers=FoundPage)
def find(
    services: Acting,
    query: Annotated[str, Query(max_length=10_000, description="In the language of docs/query.md.")] = "",
    kind: Text | None = None,
    campaign: Text | None = None,
    state: Text | None = None,
    view: Text | None = None,
    columns: Columns = None,
    limit: Limit = 50,
    after: After = None,
) -> Any:
    """Find files."""
    asked = finding.question(query, kind=kind, campaign=campaign, state=state, view=view)
    return _page(services, asked, columns, limit, after)


@dataclass(frozen=True)
class FoundStatesPage:
    """Some load states, the newest campaign first.

    Attributes
    ----------
    columns, by_view, times
        Names of the values; those of them that each view has its own of, and those that are times.
    states
        Each with its `values`, those of its `views`, and the views that meet the question.
    next
        What to go on after; None on the last page.
    """

    columns: tuple[str, ...]
    by_view: tuple[str, ...]
    times: tuple[str, ...]
    states: tuple[FoundState, ...]
    next: int | None


@ROUTES.offer("GET", "/data/states", find_states, answers=FoundStatesPage)
def states(
    services: Acting,
    query: Annotated[str, Query(max_length=10_000, description="In the language of docs/query.md.")] = "",
    kind: Text | None = None,
    campaign: Text | None = None,
    state: Text | None = None,
    view: Text | None = None,
    columns: Annotated[
        Text | None,
        Query(description="What to tell of each state, with commas between; else what is compared."),
    ] = None,
    limit: Limit = 50,
    after: After = None,
) -> Any:
    """Find load states."""
    asked = finding.question(query, kind=kind, campaign=campaign, state=state, view=view)
    page = next(find_states(services, asked, finding.portion(columns, after, limit)))
    whole = [name for name in page.columns if name not in page.by_view]
    times = (n for n in whole if any(isinstance(one.values[n], datetime) for one in page.rows))
    return answer(FoundStatesPage(page.columns, page.by_view, tuple(times), page.rows, page.next))


@ROUTES.offer("GET", "/data/queries", finding.queries, answers=returned(finding.queries))
def queries(services: Acting) -> Any:
    """Return the queries that are kept."""
    return answer(finding.queries(services))


@ROUTES.offer("POST", "/data/queries", finding.save_query, answers=returned(finding.save_query))
def save(services: Acting, body: NewQuery) -> Any:
    """Keep a query."""
    return answer(finding.save_query(services, body.name, body.text, replace=body.replace))


@ROUTES.offer("GET", "/data/queries/{name}", finding.saved_question, answers=FoundPage)
def ask(services: Acting, name: Name, columns: Columns = None, limit: Limit = 50, after: After = None) -> Any:
    """Find the files that meet a query that is kept."""
    return _page(services, finding.saved_question(services, name), columns, limit, after)


@ROUTES.offer("DELETE", "/data/queries/{name}", finding.remove_query, answers=dict[str, Any])
def remove(services: Acting, name: Name) -> Any:
    """Forget a query."""
    finding.remove_query(services, name)
    return answer({"removed": name})


def _page(services: Services, asked: Question, columns: str | None, limit: int, after: int | None) -> Any:
    page = next(finding.find(services, asked, finding.portion(columns, after, limit)))
    times = (n for n in page.columns if any(isinstance(one.values[n], datetime) for one in page.rows))
    files = [asdict(one.file) | {"values": one.values} for one in page.rows]
    return answer(FoundPage(page.columns, tuple(times), files, page.next))
