"""One page about what differs between two runs: what was not the same, by how much, and where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from sms_jobs.formats.report.charts import Axis, Chart, Line, Point, axes_block, charts
from sms_jobs.formats.report.html import Cell, Markup, paragraph, table
from sms_jobs.formats.report.maps import Held, view_markup
from sms_jobs.formats.report.page import Section, page
from sms_jobs.formats.report.tables import PER_CENT
from sms_jobs.formats.report.view import View
from sms_jobs.records.shown.runs import Difference, RunChange, RunComparison
from sms_jobs.records.subject import Subject

_STILL_PX = 420
_ABOUT = (
    "Differences are after minus before, pixel by pixel of the reference image. Stated is the rms of their "
    "standard deviation, as if both results had noise of their own; results of the same images share it, and "
    "differ by less. The part of the pixels beyond two deviations is that which changed by more than what is "
    "stated of the results."
)


@dataclass(frozen=True)
class StateMaps:
    """What differs at one state, as campaign/state: a view for each camera and its partners."""

    state: str
    views: tuple[View, ...]


def runs_page(found: RunComparison, states: Sequence[StateMaps]) -> str:
    """Return the page as HTML."""
    along = Axis("state", {name: float(place) for place, name in enumerate(_states(found))}, names=True)
    sections = [Section("What was not the same", list(_changes(found)))]
    if found.differences:
        drawn = charts(_charts(found.differences), [along])
        sections.append(Section("By how much", [axes_block([along]), drawn, _table(found.differences)]))
    drawable = [state for state in states if state.views]
    if drawable:
        sections.append(Section("Where", list(_maps(drawable))))
    return page(f"Run {found.after} against {found.before}", [paragraph(_ABOUT, faint=True)], sections)


def description(change: RunChange) -> str:
    """Say what was not the same, in a few words."""
    return " ".join(word for word in (change.what, f"{change.kind}.{change.name}".strip(".")) if word)


def _changes(found: RunComparison) -> Iterator[Markup]:
    if not found.changes:
        yield paragraph("Parameters, inputs, calibrations and versions were the same.")
    else:
        rows: list[list[Cell]] = [
            [
                description(one),
                _value(one.before),
                _value(one.after),
                one.results,
                "yes" if one.intended else "no",
            ]
            for one in found.changes
        ]
        yield table(["what", f"in {found.before}", f"in {found.after}", "results", "asked for"], rows)
    for name, alone in ((found.before, found.only_before), (found.after, found.only_after)):
        if alone:
            some = ", ".join(f"{count} {kind}" for kind, count in alone.items())
            yield paragraph(f"Only {name} has {some}.")
    if found.same:
        yield paragraph(f"{found.same} results of displacement, strain and gauges are the same in both.")
    yield from (paragraph(f"Not subtracted: {why}.") for why in found.unlike)


def _value(value: Any) -> str:
    return "–" if value is None else str(value)


def _states(found: RunComparison) -> list[str]:
    return list(dict.fromkeys(_state(one) for one in found.differences))


def _state(one: Difference) -> str:
    return str(Subject.parse(one.subject).at_state)


def _charts(differences: Sequence[Difference]) -> list[Chart]:
    """Return a chart of the rms of each quantity over the states, with a line for each view."""
    points: dict[tuple[str, str], dict[str, list[Point]]] = {}
    for one in differences:
        if one.rms is not None:
            lines = points.setdefault((one.quantity, one.unit), {})
            view = Subject.parse(one.subject).view or ""
            lines.setdefault(view, []).append(Point(_state(one), one.rms))
    return [
        Chart(f"rms change of {name}", unit, tuple(Line(key, tuple(some)) for key, some in lines.items()))
        for (name, unit), lines in points.items()
    ]


def _table(differences: Sequence[Difference]) -> Markup:
    head = [
        *("subject", "quantity", "unit", "points", "gained", "lost"),
        *("rms", "median", "largest", "stated", "beyond 2 sigma [%]"),
    ]
    rows: list[list[Cell]] = [
        [
            *(one.subject, one.quantity, one.unit, one.points, one.gained, one.lost),
            *(one.rms, one.median, one.largest, one.sigma),
            None if one.beyond is None else PER_CENT * one.beyond,
        ]
        for one in differences
    ]
    return table(head, rows)


def _maps(states: Sequence[StateMaps]) -> Iterator[Markup]:
    held, number = Held(), 0
    for state in states:
        yield Markup(f'<div class="state"><h3>State {escape(state.state)}</h3><div class="views">')
        for view in state.views:
            number += 1
            yield from view_markup(view, number, state.state, _STILL_PX, held)
        yield Markup("</div></div>")
