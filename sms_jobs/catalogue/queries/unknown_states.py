"""What is said of a state that was asked for and that there is not."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.queries.fields import different
from sms_jobs.catalogue.queries.language import UNWRITTEN, Comparison, Query, conjuncts
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import NotFound, did_you_mean


def refuse_unknown_state(session: Session, query: Query) -> None:
    """Raise `NotFound` where a query is restricted to a state that its campaign, or no campaign, has.

    What is written in the query itself asks about states, and finding none is an answer.
    """
    given = {
        one.name.text: one.value.text
        for one in conjuncts(query.condition)
        if isinstance(one, Comparison) and one.name.at == UNWRITTEN
    }
    state, campaign = given.get("state"), given.get("campaign")
    if state is None:
        return
    if campaign is not None:
        campaigns.refuse_unknown_states(session, campaign, [state])
    elif session.scalar(select(LoadStateRow.id).where(LoadStateRow.label == state).limit(1)) is None:
        meant = did_you_mean(state, session.scalars(different(LoadStateRow.label)))
        raise NotFound(
            f"no campaign has a state {state}; {meant}'sms data states' shows those that there are"
        )
