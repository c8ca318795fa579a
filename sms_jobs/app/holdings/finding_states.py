"""Finds load states by what is known of them and by what their results tell."""

from __future__ import annotations

from collections.abc import Iterator

from sms_jobs.app.holdings.finding import Question, in_pages
from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.queries import states
from sms_jobs.jobs.asking.found_states import vocabulary
from sms_jobs.records.people import Right
from sms_jobs.records.shown.portion import FIRST, Portion
from sms_jobs.records.shown.states import StatePage


@use_case(Right.READ)
def find_states(services: Services, asked: Question, told: Portion = FIRST) -> Iterator[StatePage]:
    """Yield the states that meet a question, across campaigns, page by page; at least one page.

    Parameters
    ----------
    asked
        Of its kind, if it asks for one, a state needs a result.
    told
        Of all pages together. Without columns, states tell campaign, state, load, time and what the question
        compares.

    Raises
    ------
    InvalidInput
        A name is not known, or it is compared with what it cannot be compared with.
    NotFound
        There is no such campaign, no state that the question is restricted to, or none to go on after.
    """
    names = vocabulary()

    def page(part: Portion) -> StatePage:
        with services.catalogue.reading() as session:
            return states.find_page(session, asked.query, names, DATASET_MEDIA_TYPE, part)

    return in_pages(told, page)
