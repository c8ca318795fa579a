"""How far a campaign is, state by state and view by view."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row, state_ids
from sms_jobs.errors import NotFound
from sms_jobs.records.people import Right
from sms_jobs.records.shown.cells import Cell


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
        unknown = sorted(wanted - state_ids(session, row.id).keys()) if wanted else ()
        if unknown:
            raise NotFound(
                f"campaign {campaign} has no state {unknown[0]}; 'sms campaign show {campaign}' shows its own"
            )
        return campaign_matrix.matrix(session, row, datetime.now(UTC), wanted)
