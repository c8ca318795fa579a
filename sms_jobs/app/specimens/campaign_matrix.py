"""How far a campaign is, state by state and view by view."""

from __future__ import annotations

from datetime import UTC, datetime

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row
from sms_jobs.records.people import Right
from sms_jobs.records.shown.cells import Cell


@use_case(Right.READ)
def matrix(services: Services, campaign: str) -> list[Cell]:
    """Return what there is of each state, view and kind, whether it still holds, and why it does not.

    Raises `NotFound` where there is no such campaign.
    """
    # It reads kinds and what their results are made of, which nothing else about campaigns needs.
    from sms_jobs.jobs.asking import campaign_matrix

    with services.catalogue.reading() as session:
        return campaign_matrix.matrix(session, campaign_row(session, campaign), datetime.now(UTC))
