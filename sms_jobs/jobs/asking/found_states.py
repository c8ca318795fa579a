"""The states that a question is about, as what can be submitted of each campaign."""

from __future__ import annotations

from dataclasses import replace

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue.queries.fields import Vocabulary
from sms_jobs.catalogue.queries.language import parse
from sms_jobs.catalogue.queries.states import find_page
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, REFERENCE_SURFACES
from sms_jobs.records.shown.portion import Portion

_PAGE = 1000


def vocabulary() -> Vocabulary:
    """Return the kinds and parameters that this version of the program knows."""
    return Vocabulary(_words)


def _words() -> tuple[frozenset[str], frozenset[str]]:
    kinds = all_kinds().values()
    return (
        frozenset(
            {MEASUREMENT, CALIBRATION, REFERENCE_SURFACES} | {kind.makes or kind.name for kind in kinds}
        ),
        frozenset(name for kind in kinds for name in kind.parameters.model_fields),
    )


def states_to_submit(session: Session, where: str) -> dict[str, tuple[str, ...]]:
    """Return the states that meet a question by campaign; none of a campaign of which all do.

    Of a whole campaign everything is submitted, what is about the campaign itself with it.

    Parameters
    ----------
    where
        In the language of docs/query.md, as 'sms data states' takes it.

    Raises
    ------
    InvalidInput
        The question cannot be understood, or is empty.
    NotFound
        No state meets it.
    """
    if not where.strip():
        # As from a script whose variable nobody has set.
        raise InvalidInput(
            "the question is empty, so that every state of every campaign would meet it; say which, as in "
            "'campaign = wing' or 'time in 2026'"
        )
    query, words = parse(where), vocabulary()
    labels: dict[str, list[str]] = {}
    portion = Portion(("campaign", "state"), limit=_PAGE)
    while True:
        page = find_page(session, query, words, DATASET_MEDIA_TYPE, portion)
        for one in page.rows:
            labels.setdefault(str(one.values["campaign"]), []).append(str(one.values["state"]))
        if page.next is None:
            break
        portion = replace(portion, after=page.next)
    if not labels:
        raise NotFound(f"no state meets '{where}'; look with sms data states, then submit")
    counts = dict(
        session.execute(
            select(CampaignRow.name, func.count())
            .join(LoadStateRow, LoadStateRow.campaign_id == CampaignRow.id)
            .group_by(CampaignRow.name)
        ).all()
    )
    return {name: () if len(some) == counts[name] else tuple(some) for name, some in sorted(labels.items())}
