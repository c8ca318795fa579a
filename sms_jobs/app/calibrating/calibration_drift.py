"""How far a rig has drifted from one calibration to the next: told, and drawn over time.

Each calibration has a world of its own, that of its first board. What is told is therefore how far points
have moved against each other, after the rigid motion that brings both worlds together.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sms_jobs.app.calibrating.compared_pairs import ComparedPairs
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.formats.report.charts import Axis, Chart, Line, Point, charts
from sms_jobs.records.people import Right

_MOST = 12
_MICROMETRES = 1e3
_SECONDS_A_DAY = 86400.0
_COMPARED = ComparedPairs()


@dataclass(frozen=True)
class Moved:
    """How far the points of a view have moved against each other since the first calibration.

    Attributes
    ----------
    calibration, valid_from
        The later one; its time is None where nobody knows it.
    view
        As C1P1.
    rms_mm
        Over the volume, after the rigid motion that brings both worlds together.
    expected_mm
        What the covariances of both let expect where nothing happened; None where they are not known.
    verdict
        Of the comparison of all sensors, as 'sms calibration compare' tells it.
    """

    calibration: int
    valid_from: datetime | None
    view: str
    rms_mm: float
    expected_mm: float | None
    verdict: str


@dataclass(frozen=True)
class Drift:
    """The latest calibrations of a rig against the first of them.

    Attributes
    ----------
    first, valid_from
        That which the others are compared with, None where there is none; its time also where it is unknown.
    moved
        Of each later one and each view, in the order of time; those of other sensors are left out.
    unread
        Why calibrations could not be compared, a sentence each.
    """

    rig: str
    first: int | None
    valid_from: datetime | None
    moved: tuple[Moved, ...]
    unread: tuple[str, ...] = ()


@use_case(Right.READ)
def drift(services: Services, rig: str) -> Drift:
    """Return how far points have moved from one calibration of a rig to later ones, 11 at most."""
    with services.catalogue.reading() as session:
        found = search.list_calibrations(session, rig, _MOST)[::-1]
    if not found:
        return Drift(rig, None, None, ())
    first, later = found[0], found[1:]
    compared = _COMPARED.of(services, first, later)
    moved: list[Moved] = []
    unread: dict[str, bool] = {}
    for one in later:
        told = compared[one.id]
        if isinstance(told, str):
            unread[told] = True
        else:
            moved += [Moved(one.id, one.valid_from, *pair) for pair in told]
    return Drift(rig, first.id, first.valid_from, tuple(moved), tuple(unread))


def drift_chart(found: Drift) -> str:
    """Return a drift as HTML with SVG, two lines for each view; nothing without times to draw it over."""
    if found.first is None or found.valid_from is None or not found.moved:
        return ""
    places = {
        str(one.calibration): (one.valid_from - found.valid_from).total_seconds() / _SECONDS_A_DAY
        for one in found.moved
        if one.valid_from is not None
    }
    begin = Point(str(found.first), 0.0)
    moved: dict[str, list[Point]] = {}
    expected: dict[str, list[Point]] = {}
    for one in found.moved:
        state = str(one.calibration)
        moved.setdefault(one.view, [begin]).append(Point(state, _MICROMETRES * one.rms_mm))
        if one.expected_mm is not None:
            name = f"{one.view}, expected by chance"
            expected.setdefault(name, []).append(Point(state, _MICROMETRES * one.expected_mm))
    lines = tuple(Line(name, tuple(points)) for name, points in {**moved, **expected}.items())
    axis = Axis(f"days since calibration {found.first}", {begin.state: 0.0, **places})
    return charts([Chart("points moved against each other, rms", "µm", lines)], [axis]).html
