"""Campaigns: which there are, how far each is, and what is to be computed of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import Query
from fastapi.responses import HTMLResponse

from sms_jobs.app.measuring import recordings
from sms_jobs.app.specimens import campaign_matrix, campaigns
from sms_jobs.app.work import jobs, kinds
from sms_jobs.bootstrap import Services
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.cells import Cell
from sms_jobs.web.console import Entry, Page, Pages
from sms_jobs.web.sharing import Shared

PAGES = Pages("campaigns", Entry("Campaigns", "/campaigns", 10))

_SHOWN, _MOST = 200, 10_000
_PICTURES = 24
_STATES = 50
"""That are shown at once: a page that is fetched again and again has to be quick."""
_DATASET = "application/x-hdf5"
_REMAINING: Shared[jobs.Remaining] = Shared(fresh_s=10.0)


@dataclass(frozen=True)
class Row:
    """What there is of a state and view, in the order of the columns; None where there is nothing."""

    state: str
    view: str
    cells: tuple[Cell | None, ...]

    @property
    def picture(self) -> Cell | None:
        """The last of these, along the chain of kinds, whose file has a small picture; None without one."""
        return next((cell for cell in reversed(self.cells) if cell is not None and cell.pictured), None)


@dataclass(frozen=True)
class Matrix:
    """States by views and kinds."""

    kinds: tuple[str, ...]
    rows: tuple[Row, ...]


@PAGES.show("/campaigns", campaigns.list_campaigns)
def list_(page: Page, limit: Annotated[int, Query(ge=1, le=_MOST)] = _SHOWN) -> HTMLResponse:
    """List the campaigns."""
    return page.render("campaigns.html", found=campaigns.list_campaigns(page.services, limit), most=_MOST)


@PAGES.show("/campaigns/{name}", campaigns.overview)
def show(
    page: Page,
    name: str,
    kind: str = kinds.EVERYTHING,
    first: Annotated[int, Query(ge=1, le=1_000_000)] = 1,
) -> HTMLResponse:
    """Show how far a campaign is: states from the `first` on, and the parameters of a `kind`."""
    services = page.services
    story = campaigns.overview(services, name)
    every = [state.label for state in story.campaign.states]
    first = min(first, len(every))
    states = every[first - 1 : first - 1 + _STATES]
    cells = campaign_matrix.matrix(services, name, states)
    offered = kinds.list_kinds(services)
    order = list(dict.fromkeys(cell.kind for cell in cells))
    cells = campaign_matrix.in_order(cells, story.campaign)
    pictured = [c for c in cells if c.view is not None and c.pictured]
    documents = [c for c in cells if c.file is not None and c.media_type != _DATASET]
    return page.render(
        "campaign.html",
        story=story,
        campaign=story.campaign,
        tuples=matrix([c for c in cells if c.view is not None], order),
        wholes=matrix([c for c in cells if c.view is None], order),
        pictures=_latest(pictured, order)[:_PICTURES],
        documents=documents,
        progress=recordings.progress(services, name, states),
        first=first,
        before=max(1, first - _STATES) if first > 1 else None,
        after=first + _STATES if first + _STATES <= len(every) else None,
        remaining=_remaining(services, name, story.jobs),
        running=jobs.list_jobs(services, campaign=name, states=[JobState.RUNNING], limit=20),
        kinds=offered,
        everything=kinds.EVERYTHING,
        kind=next((one for one in offered if one.name == kind), None),
    )


def _remaining(services: Services, name: str, counted: Mapping[str, int]) -> jobs.Remaining:
    """Return how the jobs of a campaign come along, estimated again once a state has other numbers of them.

    While nobody's number changes an estimate differs by the seconds that have passed.
    """
    known_by = (services.settings.home, name, tuple(sorted(counted.items())))
    return _REMAINING.of(known_by, lambda: jobs.remaining(services, name))


def matrix(cells: Sequence[Cell], order: Sequence[str]) -> Matrix:
    """Lay cells out in their order: a row for each state and view, a column for each kind that is there."""
    columns = tuple(sorted({c.kind for c in cells}, key=lambda name: _place(name, order)))
    found = {(c.state or "", c.view or "", c.kind): c for c in cells}
    places = dict.fromkeys((state, view) for state, view, _ in found)
    rows = [Row(state, view, tuple(found.get((state, view, k)) for k in columns)) for state, view in places]
    return Matrix(columns, tuple(rows))


def _latest(cells: Iterable[Cell], order: Sequence[str]) -> list[Cell]:
    """Return those whose kind comes last in the chain first, and else in their order."""
    return sorted(cells, key=lambda cell: -_place(cell.kind, order))


def _place(name: str, order: Sequence[str]) -> int:
    return order.index(name) if name in order else len(order)
