"""Load states as they are shown: found, with what was asked about them and about each of their views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeAlias

from sms_jobs.records.views import place_of_view

Value: TypeAlias = float | str | datetime | None

MET_BY = "met_by"
"""The column of the views that meet a question about views."""


@dataclass(frozen=True)
class FoundState:
    """A state, and what was asked about it, in the units of the question; None where nothing is known.

    Attributes
    ----------
    id
        To go on after.
    values
        By column, of the state as a whole.
    views
        By view, what its newest results tell, by column.
    met_by
        The views that meet the question; None where it asks nothing about views.
    """

    id: int
    values: dict[str, Value]
    views: dict[str, dict[str, float]]
    met_by: tuple[str, ...] | None


@dataclass(frozen=True)
class StatePage:
    """Some of the states that meet a question: the newest campaign first, its states in their order.

    Attributes
    ----------
    columns
        In the order of the question.
    by_view
        Those of them that each view has its own value of.
    next
        What to go on after to get the next page; None on the last one.
    """

    columns: tuple[str, ...]
    by_view: tuple[str, ...]
    rows: tuple[FoundState, ...]
    next: int | None


def table_of(
    columns: Sequence[str], by_view: Sequence[str], states: Sequence[FoundState]
) -> tuple[list[str], Iterator[list[Any]]]:
    """Return columns and rows, one a state; what views tell has a column for each: `valid_fraction C1P1`."""
    views = sorted({view for one in states for view in one.views}, key=place_of_view)
    met = [MET_BY] if any(one.met_by is not None for one in states) else []
    titles: list[str] = []
    for name in columns:
        titles += [f"{name} {view}" for view in views] if name in by_view else [name]

    def row(one: FoundState) -> list[Any]:
        cells: list[Any] = []
        for name in columns:
            of_views = (one.views.get(view, {}).get(name) for view in views)
            cells += of_views if name in by_view else [one.values[name]]
        return cells + [" ".join(one.met_by or ())] * len(met)

    return titles + met, (row(one) for one in states)
