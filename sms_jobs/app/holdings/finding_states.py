"""Finds load states by what is known of them and by what their results tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sms_jobs.app.holdings.finding import Question
from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.queries import states
from sms_jobs.jobs.asking.found_states import vocabulary
from sms_jobs.records.people import Right
from sms_jobs.records.shown.states import StatePage

_PAGE = 1000
"""States that are fetched at once, however many are asked for."""


@use_case(Right.READ)
def find_states(
    services: Services,
    asked: Question,
    *,
    columns: Sequence[str] | None = None,
    after: int | None = None,
    limit: int = 50,
) -> Iterator[StatePage]:
    """Yield the states that meet a question, across campaigns, page by page; at least one page.

    Parameters
    ----------
    asked
        Of its kind, if it asks for one, a state needs a result.
    columns
        What to tell of each state, in names of docs/query.md; campaign, state, load, time and what the
        question compares if it is None.
    after
        `StatePage.next` of the last page that is known already.
    limit
        Of all pages together.

    Raises
    ------
    InvalidInput
        A name is not known, or it is compared with what it cannot be compared with.
    NotFound
        There is no such campaign, or no state to go on after.
    """
    names = vocabulary()
    while True:
        with services.catalogue.reading() as session:
            page = states.find_page(
                session,
                asked.query,
                names,
                DATASET_MEDIA_TYPE,
                columns=columns,
                after=after,
                limit=min(limit, _PAGE),
            )
        yield page
        limit, after = limit - len(page.found), page.next
        if limit <= 0 or after is None:
            return
