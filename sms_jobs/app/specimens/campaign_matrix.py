"""How far a campaign is, state by state and view by view."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row, refuse_unknown_states
from sms_jobs.records.people import Right
from sms_jobs.records.shown.cells import Cell
from sms_jobs.records.views import place_of_view

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign


def in_order(cells: Iterable[Cell], campaign: Campaign) -> list[Cell]:
    """Return cells by the campaign's states, then by views, camera before partners; of each the oldest first.

    Behind the tuples of a state comes what is about all of it, and at the end what is about the campaign.
    """
    states = {state.label: number for number, state in enumerate(campaign.states)}

    def place(cell: Cell) -> tuple[int, bool, tuple[tuple[int, int], ...]]:
        view = () if cell.view is None else place_of_view(cell.view)
        return states.get(cell.state or "", len(states)), cell.view is None, view

    return sorted(cells, key=place)


@use_case(Right.READ)
def matrix(services: Services, campaign: str, states: Sequence[str] = ()) -> list[Cell]:
    """Return what there is of each state, view and kind, whether it still holds, and why it does not.

    Parameters
    ----------
    states
        Labels of those of which it is returned, beside what is about the whole campaign; all if empty.

    Raises
    ------
    NotFound
        There is no such campaign, or it has no such state.
    """
    # It reads kinds and what their results are made of, which nothing else about campaigns needs.
    from sms_jobs.jobs.asking import campaign_matrix

    with services.catalogue.reading() as session:
        row = campaign_row(session, campaign)
        wanted = frozenset(states)
        refuse_unknown_states(session, campaign, wanted)
        return campaign_matrix.matrix(session, row, datetime.now(UTC), wanted)
