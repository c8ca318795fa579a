"""How much of what meets a question is told, and what of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Portion:
    """A part of what meets a question.

    Attributes
    ----------
    columns
        What to tell of each, in names of docs/query.md; None for what is told unasked.
    after
        `next` of the last page that is known already; None to begin.
    limit
        How many at the most.
    """

    columns: Sequence[str] | None = None
    after: int | None = None
    limit: int = 50


FIRST = Portion()
