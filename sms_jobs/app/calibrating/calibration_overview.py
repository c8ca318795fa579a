"""How accurate a calibration is, in numbers; also that of a session."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sms_jobs.app.calibrating.calibrations import QualitySummary, quality_summary, show
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.records.people import Right
from sms_jobs.records.sensors import Box, Sensor
from sms_jobs.records.shown.files import DecisionView, FileView
from sms_jobs.records.shown.times import known_time


@dataclass(frozen=True)
class Overview:
    """A calibration, its time and accuracy, None where they are unknown, and what was decided about it."""

    calibration: int
    rig: str
    valid_from: datetime | None
    origin: str
    path: str
    sensors: tuple[Sensor, ...]
    volume: Box
    quality: QualitySummary | None
    decisions: tuple[DecisionView, ...]


@use_case(Right.READ)
def overview(services: Services, number: int) -> Overview:
    """Return a calibration in numbers, without its samples; raises as `show` does."""
    from sms_jobs.jobs.archiving import acceptances

    known = show(services, number)
    made, quality = known.calibration, known.quality
    worth = None if quality is None else quality_summary(quality)
    return Overview(
        number,
        made.rig.name,
        known_time(made.valid_from),
        made.origin,
        known.path,
        made.rig.sensors,
        made.volume,
        worth,
        tuple(acceptances.about(services.catalogue, services.archive, number)),
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
    quality
        By which it is judged.
    """

    session: str
    rig: str
    file: FileView
    sensors: tuple[str, ...]
    volume_diagonal_mm: float
    quality: QualitySummary | None


@use_case(Right.READ)
def candidate(services: Services, session: str) -> Candidate:
    """Return the calibration that a session gave; raises `NotFound` where it has given none."""
    from sms_jobs.jobs.archiving import calibrations

    file, known = calibrations.session_result(services.catalogue, services.archive, session)
    made = known.calibration
    return Candidate(
        session,
        made.rig.name,
        file,
        tuple(sensor.name for sensor in made.rig.sensors),
        made.volume.diagonal_mm,
        None if known.quality is None else quality_summary(known.quality),
    )
