"""What is said of a state or view that was asked for and that there is not."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.queries.fields import different
from sms_jobs.catalogue.queries.language import UNWRITTEN, Comparison, Query, conjuncts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import NotFound, did_you_mean
from sms_jobs.records.views import view_of

_MOST_VIEWS = 10
"""So many of the views that there are are named."""


def refuse_unknown_places(session: Session, query: Query) -> None:
    """Raise `NotFound` where a query is restricted to a state or view that its campaign, or no campaign, has.

    What is written in the query itself asks about states and views, and finding none is an answer.
    """
    given = {
        one.name.text: one.value.text
        for one in conjuncts(query.condition)
        if isinstance(one, Comparison) and one.name.at == UNWRITTEN
    }
    campaign = given.get("campaign")
    if (state := given.get("state")) is not None:
        _refuse_unknown_state(session, state, campaign)
    if (view := given.get("view")) is not None:
        _refuse_unknown_view(session, view, campaign)


def _refuse_unknown_state(session: Session, state: str, campaign: str | None) -> None:
    if campaign is not None:
        campaigns.refuse_unknown_states(session, campaign, [state])
    elif session.scalar(select(LoadStateRow.id).where(LoadStateRow.label == state).limit(1)) is None:
        meant = did_you_mean(state, session.scalars(different(LoadStateRow.label)))
        raise NotFound(
            f"no campaign has a state {state or repr(state)}; {meant}"
            "'sms data states' shows those that there are"
        )


def _refuse_unknown_view(session: Session, view: str, campaign: str | None) -> None:
    """Refuse a view that is neither planned, nor what one of those records, nor that of any file."""
    known, filed = select(CampaignRow.views), select(FileRow.id).where(FileRow.view == view)
    if campaign is not None:
        number = campaigns.campaign_id(session, campaign)
        known, filed = known.where(CampaignRow.id == number), filed.where(FileRow.campaign_id == number)
    if session.scalar(filed.limit(1)) is not None:
        return
    planned = list(dict.fromkeys(one for views in session.scalars(known) for one in views))
    recorded = (str(one) for name in planned for one in view_of(name).recordings)
    if view not in {*planned, *recorded}:
        who = "no campaign has a view" if campaign is None else f"campaign {campaign} has no view"
        meant = did_you_mean(view, planned)
        there = f"; {meant}there are {', '.join(planned[:_MOST_VIEWS])}" if planned else ""
        raise NotFound(f"{who} {view or repr(view)}{there}")
