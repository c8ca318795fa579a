"""What rows are about, where their column holds a subject as text."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection
from typing import Any

from sqlalchemy import ColumnElement, func, or_
from sqlalchemy.orm import InstrumentedAttribute


def at_states(
    subject: InstrumentedAttribute[str] | ColumnElement[str], campaign: str, labels: Collection[str]
) -> ColumnElement[bool]:
    """Select what is about a campaign as a whole, or about some of its states or tuples of these.

    The rows have to be of that campaign. The database cuts the label out of the text, so that rows of other
    states are never read: no index orders texts alike on both databases.

    Parameters
    ----------
    subject
        The column, whose texts are as `str(Subject)` writes them.
    campaign
        Its name.
    labels
        Of the states.
    """
    by_length: defaultdict[int, list[str]] = defaultdict(list)
    for label in labels:
        by_length[len(label)].append(f"{label}/")
    within: ColumnElement[Any] = subject.concat("/")
    cut = (func.substr(within, len(campaign) + 2, length + 1).in_(some) for length, some in by_length.items())
    return or_(subject == campaign, *cut)
