"""How far a rig has drifted from one calibration to the next: told, and drawn over time.

Each calibration has a world of its own, that of its first board. What is told is therefore how far points
have moved against each other, after the rigid motion that brings both worlds together.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from datetime import datetime
from math import isfinite
from typing import NamedTuple

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, NotFound, OtherFormat
from sms_jobs.formats.report.charts import Axis, Chart, Line, Point, charts
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import CalibrationView

_MOST, _KEPT = 12, 1000
_MICROMETRES = 1e3
_SECONDS_A_DAY = 86400.0


@dataclass(frozen=True)
class Moved:
    """How far the points of a view have moved against each other since the first calibration.

    Attributes
    ----------
    calibration, valid_from
        The later one.
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
    valid_from: datetime
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
        That which the others are compared with; None where there is none.
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
    first, unread = found[0], dict[str, bool]()
    moved: list[Moved] = []
    for one in found[1:]:
        try:
            pairs = _COMPARED.of(services, first, one)
        except (ArchiveCorrupt, NotFound, OtherFormat) as error:
            unread[str(error)] = True
            continue
        moved += [Moved(one.id, one.valid_from, *pair) for pair in pairs]
    return Drift(rig, first.id, first.valid_from, tuple(moved), tuple(unread))


class _Pair(NamedTuple):
    """What `Moved` tells of a view, whichever numbers the calibrations have."""

    view: str
    rms_mm: float
    expected_mm: float | None
    verdict: str


def _compared(services: Services, first: CalibrationView, one: CalibrationView) -> tuple[_Pair, ...]:
    """Read two calibrations and compare them, view by view; nothing where they are of other sensors."""
    from sms_jobs.jobs.archiving import calibrations

    try:
        changed, _ = calibrations.compare(services.catalogue, services.archive, first.id, one.id, None)
    except InvalidInput:
        return ()
    return tuple(
        _Pair(
            f"{pair.camera}{pair.projector}",
            pair.aligned_rms_mm,
            pair.expected_aligned_rms_mm if isfinite(pair.expected_aligned_rms_mm) else None,
            changed.verdict,
        )
        for pair in changed.pairs
    )


class _Compared:
    """Comparisons by what was sealed, which never changes: the page is opened again and again.

    A file that is gone or of another size is read, which says so. What else may be wrong with it is found by
    those who read or verify it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: dict[tuple[str, str], tuple[_Pair, ...]] = {}

    def of(self, services: Services, first: CalibrationView, one: CalibrationView) -> tuple[_Pair, ...]:
        """Return what `_compared` returned for these contents; what it raises is tried again next time."""
        hashes = (first.content_hash, one.content_hash)
        with self._lock:
            known = self._found.get(hashes)
        if known is not None and all(_is_there(services, view) for view in (first, one)):
            return known
        known = _compared(services, first, one)
        with self._lock:
            self._found[hashes] = known
            if len(self._found) > _KEPT:
                del self._found[next(iter(self._found))]
        return known


def _is_there(services: Services, view: CalibrationView) -> bool:
    return services.archive.size(view.path) == view.size_bytes


_COMPARED = _Compared()


def drift_chart(found: Drift) -> str:
    """Return a drift as HTML with SVG, two lines for each view; nothing without a later calibration."""
    if found.first is None or found.valid_from is None or not found.moved:
        return ""
    places = {
        str(one.calibration): (one.valid_from - found.valid_from).total_seconds() / _SECONDS_A_DAY
        for one in found.moved
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
