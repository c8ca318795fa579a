"""Charts over the states of a campaign: lines with error bars, drawn as SVG that needs no script."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from math import ceil, floor, isfinite, log10

from sms_jobs.formats.report.html import Markup, number
from sms_jobs.formats.report.page import json_block
from sms_jobs.records.campaign import LoadState

_WIDTH, _HEIGHT = 560, 330
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 14, 12, 46
_COLOURS = 6
_TICKS = 6
_LARGEST_LABELS = 12


@dataclass(frozen=True)
class Axis:
    """What the states are laid out along.

    Attributes
    ----------
    label
        With unit.
    places
        Of every state that has one, by label.
    names
        Whether the ticks are the names of the states.
    """

    label: str
    places: dict[str, float]
    names: bool = False


@dataclass(frozen=True)
class Point:
    """One value of a line: at a state, with its standard deviation where one is known."""

    state: str
    value: float
    sigma: float | None = None


@dataclass(frozen=True)
class Line:
    """Values of one quantity over the states."""

    name: str
    points: tuple[Point, ...]


@dataclass(frozen=True)
class Chart:
    """Lines that share one quantity and unit."""

    title: str
    unit: str
    lines: tuple[Line, ...]


def axes(states: Sequence[LoadState]) -> tuple[Axis, ...]:
    """Return what a campaign can be charted along: load, displacement, channels that vary, the states.

    Loads and displacements are those that were read, where they were.
    """
    readings: dict[str, dict[str, float]] = {"load [N]": {}, "applied displacement [mm]": {}}
    for state in states:
        if state.known_load_n is not None:
            readings["load [N]"][state.label] = state.known_load_n
        if state.known_displacement_mm is not None:
            readings["applied displacement [mm]"][state.label] = state.known_displacement_mm
        for name, value in sorted(state.channels.items()):
            readings.setdefault(name, {})[state.label] = value
    found = [Axis(n, values) for n, values in readings.items() if len(set(values.values())) > 1]
    order = Axis("state", {s.label: float(place) for place, s in enumerate(states)}, names=True)
    return (*found, order)


def ticks(low: float, high: float, count: int = _TICKS) -> tuple[float, ...]:
    """Return round numbers from `low` to `high`: 1, 2 or 5 times a power of ten apart."""
    if not high > low:
        return (low,)
    rough = (high - low) / count
    power = 10.0 ** floor(log10(rough))
    step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= rough * (1.0 - 1e-9))
    first, last = ceil(low / step - 1e-9), floor(high / step + 1e-9)
    return tuple(step * place for place in range(first, last + 1))


def charts(found: Sequence[Chart], along: Sequence[Axis]) -> Markup:
    """Draw charts along each axis; the first is shown, the script lets the reader choose another."""
    drawn = "".join(
        f'<figure class="chart{"" if place == 0 else " other"}" data-axis="{place}">{_svg(chart, axis)}'
        f"<figcaption>{escape(_caption(chart, axis))}</figcaption></figure>\n"
        for chart in found
        for place, axis in enumerate(along)
    )
    names = escape("\n".join(axis.label for axis in along))
    return Markup(f'<div class="charting" data-axes="{names}"><div class="charts">{drawn}</div></div>')


def axes_block(along: Sequence[Axis]) -> Markup:
    """Tell the script what points can be followed along."""
    descriptions = [{"label": a.label, "places": a.places, "names": a.names} for a in along]
    return json_block(descriptions, "axes")


def _caption(chart: Chart, axis: Axis) -> str:
    bars = any(p.sigma is not None for line in chart.lines for p in line.points)
    return f"{chart.title} over {axis.label}" + ("; bars are one standard deviation" if bars else "")


@dataclass(frozen=True)
class _Scale:
    """Maps values onto the page."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        part = (value - self.low) / (self.high - self.low)
        return round(self.start + part * (self.end - self.start), 1)


def _scales(chart: Chart, axis: Axis) -> tuple[_Scale, _Scale]:
    xs = [axis.places[p.state] for line in chart.lines for p in line.points if p.state in axis.places]
    spans = [(p.value, p.sigma or 0.0) for line in chart.lines for p in line.points]
    ys = [edge for value, sigma in spans for edge in (value - sigma, value + sigma)]
    x_low, x_high = _with_room(min(xs, default=0.0), max(xs, default=1.0))
    y_low, y_high = _with_room(min(ys, default=0.0), max(ys, default=1.0))
    return (
        _Scale(x_low, x_high, _LEFT, _WIDTH - _RIGHT),
        _Scale(y_low, y_high, _HEIGHT - _BOTTOM, _TOP),
    )


def _with_room(low: float, high: float) -> tuple[float, float]:
    room = 0.04 * (high - low) or 0.5 * abs(high) or 1.0
    return low - room, high + room


def _svg(chart: Chart, axis: Axis) -> str:
    x, y = _scales(chart, axis)
    words = escape(_caption(chart, axis))
    # Room for the names below, two in a row.
    height = _HEIGHT + 18 * ceil(len(chart.lines) / 2)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{words}">',
        _frame(chart, axis, x, y),
    ]
    for place, line in enumerate(chart.lines):
        parts.append(_line(line, axis, x, y, place % _COLOURS, chart.unit))
        left, top = _LEFT + (place % 2) * 245, _HEIGHT + 6 + 18 * (place // 2)
        parts.append(
            f'<path class="line t{place % _COLOURS}" d="M{left} {top}h20"/>{_mark(left + 10, top, place)}'
        )
        parts.append(f'<text x="{left + 26}" y="{top + 4}">{escape(line.name)}</text>')
    return "".join([*parts, "</svg>"])


def _frame(chart: Chart, axis: Axis, x: _Scale, y: _Scale) -> str:
    bottom, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
    parts = []
    for value in ticks(y.low, y.high):
        parts.append(f'<path class="grid" d="M{_LEFT} {y(value)}H{right}"/>')
        label = number(0.0 if abs(value) < 1e-12 * (y.high - y.low) else value)
        parts.append(f'<text x="{_LEFT - 6}" y="{y(value) + 4}" text-anchor="end">{label}</text>')
    labels = [(value, number(round(value, 12))) for value in ticks(x.low, x.high)]
    if axis.names:
        every = ceil(len(axis.places) / _LARGEST_LABELS)
        named = list(axis.places.items())[::every]
        # A state without a value, as the reference of a displacement, lies beyond the chart.
        labels = [(place, escape(name)) for name, place in named if x.low <= place <= x.high]
    for value, label in labels:
        parts.append(f'<path class="grid" d="M{x(value)} {_TOP}V{bottom}"/>')
        parts.append(f'<text x="{x(value)}" y="{bottom + 17}" text-anchor="middle">{label}</text>')
    unit = f" [{chart.unit}]" if chart.unit else ""
    middle = (_TOP + bottom) / 2
    return (
        "".join(parts)
        + f'<path class="axis" d="M{_LEFT} {_TOP}V{bottom}H{right}"/>'
        + f'<text x="{(_LEFT + right) / 2}" y="{bottom + 37}" text-anchor="middle">'
        + f"{escape(axis.label)}</text>"
        + f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">'
        + f"{escape(chart.title + unit)}</text>"
    )


def _line(line: Line, axis: Axis, x: _Scale, y: _Scale, colour: int, unit: str) -> str:
    shown = [
        (x(axis.places[p.state]), p) for p in line.points if p.state in axis.places and isfinite(p.value)
    ]
    path = "M" + "L".join(f"{left} {y(p.value)}" for left, p in shown) if shown else ""
    parts = [f'<path class="line t{colour}" d="{path}"/>'] if path else []
    for left, point in shown:
        words = f"{line.name}, {point.state}: {number(point.value)}"
        bar = ""
        if point.sigma is not None and isfinite(point.sigma):
            words += f" ± {number(point.sigma)}"
            low, high = y(point.value - point.sigma), y(point.value + point.sigma)
            ends = f"M{left - 4} {low}h8M{left - 4} {high}h8"
            bar = f'<path class="bar t{colour}" d="M{left} {low}V{high}{ends}"/>'
        label = escape(f"{words} {unit}".strip())
        parts.append(f"<g><title>{label}</title>{bar}{_mark(left, y(point.value), colour)}</g>")
    return "".join(parts)


def _mark(x: float, y: float, colour: int) -> str:
    """Draw a marker whose shape tells the line as well as its colour does."""
    shapes = (
        "m-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0z",
        "m-3.5 -3.5h7v7h-7z",
        "m0 -4.5l4.5 8h-9z",
        "m0 -5l5 5l-5 5l-5 -5z",
        "m0 4.5l4.5 -8h-9z",
        "m-5 -1.5h10v3h-10z",
    )
    return f'<path class="f{colour % _COLOURS}" d="M{x} {y}{shapes[colour % _COLOURS]}"/>'
