"""What a report follows over the states: points of the surface, and the numbers of each view."""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape

import numpy as np

from sms_jobs.formats.report.charts import Chart, Line, Point
from sms_jobs.formats.report.html import Cell, Markup, number, table
from sms_jobs.formats.report.view import Field, Statistic, View

_PERCENTILE = 99.0


@dataclass(frozen=True)
class Place:
    """A point of the surface that a field is followed at: a sample of the views of one key."""

    key: str
    name: str
    unit: str
    row: int
    column: int
    row_px: int
    column_px: int

    @property
    def words(self) -> str:
        """Where it is."""
        return f"{self.key} at ({self.column_px}, {self.row_px}) px"


def places(view: View) -> tuple[Place, ...]:
    """Return where each followed field of a view is large: at the 99th percentile of what it is in size.

    The largest value of all would be followed for its noise as much as for what it measures.
    """
    found = []
    for each in view.fields:
        known = np.isfinite(each.values)
        if not each.followed or not known.any():
            continue
        size = np.where(known, np.abs(each.values), np.nan)
        away = np.abs(size - np.nanpercentile(size, _PERCENTILE))
        row, column = (int(p) for p in np.unravel_index(int(np.nanargmin(away)), away.shape))
        half = view.step_px // 2
        pixel = (row * view.step_px + half, column * view.step_px + half)
        found.append(Place(view.key, each.name, each.unit, row, column, *pixel))
    return tuple(found)


def _cell(one: Statistic) -> Cell:
    """Return a number, with its standard deviation where the table is to show it."""
    if one.charted and one.value is not None and one.sigma is not None:
        return f"{number(one.value)} ± {number(one.sigma)}"
    return one.value


@dataclass
class Followed:
    """Collects, view by view, what is charted and tabled."""

    at: tuple[Place, ...]
    _readings: dict[Place, list[Point]] = field(default_factory=dict)
    _charted: dict[tuple[str, str], dict[str, list[Point]]] = field(default_factory=dict)
    _rows: list[tuple[str, str, tuple[Statistic, ...]]] = field(default_factory=list)

    def add(self, state: str, view: View) -> None:
        """Read a view of a state; its images are not kept."""
        fields = {each.name: each for each in view.fields}
        for place in self.at:
            if place.key == view.key and place.name in fields:
                self._read(place, fields[place.name], state)
        for one in view.statistics:
            if one.charted and one.value is not None:
                lines = self._charted.setdefault((one.name, one.unit), {})
                lines.setdefault(view.key, []).append(Point(state, one.value, one.sigma))
        self._rows.append((state, view.key, view.statistics))

    def _read(self, place: Place, found: Field, state: str) -> None:
        value = float(found.values[place.row, place.column])
        sigma = None if found.sigma is None else float(found.sigma[place.row, place.column])
        if np.isfinite(value):
            points = self._readings.setdefault(place, [])
            points.append(Point(state, value, sigma if sigma is not None and np.isfinite(sigma) else None))

    def charts(self) -> tuple[Chart, ...]:
        """Return a chart of every followed field and of every charted statistic."""
        by_field: dict[tuple[str, str], list[Line]] = {}
        for place, points in self._readings.items():
            by_field.setdefault((place.name, place.unit), []).append(Line(place.words, tuple(points)))
        followed = (
            Chart(f"{name} of a point", unit, tuple(lines)) for (name, unit), lines in by_field.items()
        )
        counted = (
            Chart(name, unit, tuple(Line(key, tuple(points)) for key, points in lines.items()))
            for (name, unit), lines in self._charted.items()
        )
        return (*followed, *counted)

    def tables(self) -> list[Markup]:
        """Return a table of all states for every set of statistics that views have."""
        made: dict[tuple[str, tuple[str, ...]], list[list[Cell]]] = {}
        for state, key, statistics in self._rows:
            for group in dict.fromkeys(one.group for one in statistics):
                mine = [one for one in statistics if one.group == group]
                heads = tuple(f"{one.name} [{one.unit}]" if one.unit else one.name for one in mine)
                made.setdefault((group, heads), []).append([state, key, *(_cell(one) for one in mine)])
        parts = []
        for (group, heads), rows in made.items():
            parts += [Markup(f"<h3>{escape(group)}</h3>")] if group else []
            parts.append(table(["state", "camera", *heads], rows))
        return parts
