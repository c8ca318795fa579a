"""What a calibration is worth in numbers, that of a session too, and the drift of a rig over time."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sms_jobs.app.calibrations import Worth, show, worth_of
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.report.charts import Axis, Chart, Line, Point, charts
from sms_jobs.records.people import Right
from sms_jobs.records.sensors import Box, Sensor
from sms_jobs.records.shown.files import FileView

_MOST = 12
_MICROMETRES = 1e3
_SECONDS_A_DAY = 86400.0


@dataclass(frozen=True)
class Overview:
    """A calibration and what it is worth; None for one that was brought in."""

    calibration: int
    rig: str
    valid_from: datetime
    origin: str
    path: str
    sensors: tuple[Sensor, ...]
    volume: Box
    worth: Worth | None


@use_case(Right.READ)
def overview(services: Services, number: int) -> Overview:
    """Return a calibration in numbers, without its samples; raises as `show` does."""
    known = show(services, number)
    made, quality = known.calibration, known.quality
    worth = None if quality is None else worth_of(quality)
    return Overview(
        number,
        made.rig.name,
        made.valid_from,
        made.origin,
        known.path,
        made.rig.sensors,
        made.volume,
        worth,
    )


@dataclass(frozen=True)
class Candidate:
    """The calibration that a session gave, before it is taken into use.

    Attributes
    ----------
    session, rig
        By name.
    file
        Where it lies.
    sensors
        Names of its sensors.
    volume_diagonal_mm
        Of the volume that it is for.
    worth
        By which it is judged.
    """

    session: str
    rig: str
    file: FileView
    sensors: tuple[str, ...]
    volume_diagonal_mm: float
    worth: Worth | None


@use_case(Right.READ)
def candidate(services: Services, session: str) -> Candidate:
    """Return the calibration that a session gave; raises `NotFound` where it has given none."""
    from sms_jobs.jobs import calibrations

    file, known = calibrations.session_result(services.catalogue, services.archive, session)
    made = known.calibration
    return Candidate(
        session,
        made.rig.name,
        file,
        tuple(sensor.name for sensor in made.rig.sensors),
        made.volume.diagonal_mm,
        None if known.quality is None else worth_of(known.quality),
    )


@use_case(Right.READ)
def drift_chart(services: Services, rig: str) -> str:
    """Return a chart of how far points have moved since the first calibration of a rig, as HTML with SVG.

    The latest calibrations that can be compared are shown, a line for each view; nothing where there are
    fewer than two.
    """
    from sms_jobs.jobs import calibrations

    with services.catalogue.reading() as session:
        found = search.list_calibrations(session, rig)[:_MOST][::-1]
    if len(found) < 2:
        return ""
    first = found[0]
    places = {
        str(one.id): (one.valid_from - first.valid_from).total_seconds() / _SECONDS_A_DAY for one in found
    }
    points: dict[str, list[Point]] = {}
    for one in found[1:]:
        try:
            changed, _ = calibrations.compare(services.catalogue, services.archive, first.id, one.id, None)
        except InvalidInput:
            continue  # of other sensors: there is nothing to compare
        for pair in changed.pairs:
            points.setdefault(f"{pair.camera}{pair.projector}", []).append(
                Point(str(one.id), _MICROMETRES * pair.rms_mm)
            )
    lines = tuple(Line(view, (Point(str(first.id), 0.0), *moved)) for view, moved in points.items())
    axis = Axis(f"days since calibration {first.id}", places)
    return charts([Chart("points moved, rms", "µm", lines)], [axis]).html if lines else ""
