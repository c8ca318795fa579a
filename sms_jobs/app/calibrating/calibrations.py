"""Calibrations of rigs: shown, certified, compared, and taken into use; in the files of other programs too.

What computes with them is imported by the functions that need it: its kernels take a second, for which
whoever lists them would wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.interchange.styles import Style
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import CalibrationView
from sms_jobs.records.shown.times import known_time
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.jobs.archiving.calibrations import CalibrationCheck, KnownCalibration
    from sms_jobs.jobs.archiving.registration import Registered
    from sms_jobs.metrology.calibration.checking.comparison import CalibrationComparison
    from sms_jobs.records.calibration import CalibrationQuality, Signed
    from sms_jobs.records.sensors import Calibration, Sensor
    from sms_jobs.records.supplements import Supplement

STYLES: tuple[str, ...] = get_args(Style)
"""Names of the files of other programs that calibrations are written as."""
_ENDINGS: dict[str, tuple[str, ...]] = {
    "opencv-yaml": (".yml", ".yaml"),
    "opencv-xml": (".xml",),
    "opencv-json": (".json",),
    "thesis-xml": (".xml",),
}


def distortion(sensors: Sequence[Sensor]) -> tuple[str, ...]:
    """Return the names of the coefficients that the lens of any of some sensors has."""
    from sms_jobs.metrology.geometry.lens import COEFFICIENTS, foreign

    none_has = set.intersection(*(set(foreign(s.intrinsics.model)) for s in sensors))
    return tuple(name for name in COEFFICIENTS if name not in none_has)


@use_case(Right.READ)
def list_calibrations(services: Services, rig: str | None = None) -> list[CalibrationView]:
    """Return the calibrations of a rig, or all: the one that became valid last first."""
    with services.catalogue.reading() as session:
        return search.list_calibrations(session, rig)


@use_case(Right.READ)
def show(services: Services, number: int) -> KnownCalibration:
    """Return a calibration with what is known of it; raises `NotFound` where there is no such one."""
    from sms_jobs.jobs.archiving import calibrations

    return calibrations.known_calibration(services.catalogue, services.archive, number)


@dataclass(frozen=True)
class QualitySummary:
    """The few numbers by which a calibration is judged; None for one that is not known.

    Attributes
    ----------
    gauge, scale
        What fixes the world's frame, and what lengths were taken from.
    shape_sigma_mm
        Deviation of a point, but for motions and the scale of the whole.
    estimates
        What was found of the artefacts themselves; names carry the unit.
    residuals, parameters
        Of the adjustment.
    rms_by_type, rms_by_sensor
        Root mean square of the residuals; names carry the unit.
    refused
        How many observations were left out, by reason.
    warnings
        What a person has to look at before it is used.
    held_out_bar_rms_mm
        Of the lengths of ball bars, each by a calibration that it took no part in.
    expected_median_mm, expected_largest_mm
        Deviation of a point that the calibration alone lets expect.
    """

    gauge: str
    scale: str
    shape_sigma_mm: float | None
    estimates: dict[str, float]
    residuals: int
    parameters: int
    rms_by_type: dict[str, float | None]
    rms_by_sensor: dict[str, float | None]
    refused: dict[str, int]
    warnings: tuple[str, ...]
    held_out_bar_rms_mm: float | None
    expected_median_mm: float | None
    expected_largest_mm: float | None


def quality_summary(quality: CalibrationQuality) -> QualitySummary:
    """Return the few numbers by which a calibration is judged."""
    import numpy as np

    expected = quality.expected_sigma[np.isfinite(quality.expected_sigma)]
    return QualitySummary(
        quality.gauge,
        quality.scale,
        quality.shape_sigma_mm,
        quality.labelled(),
        quality.residuals,
        quality.parameters,
        {name: _known(value) for name, value in quality.rms_by_type.items()},
        {name: _known(value) for name, value in quality.rms_by_sensor.items()},
        dict(quality.refused),
        quality.warnings,
        _known(quality.held_out_bar_rms_mm()),
        float(np.median(expected)) if expected.size else None,
        float(expected.max()) if expected.size else None,
    )


def _known(value: float) -> float | None:
    return float(value) if isfinite(value) else None


@dataclass(frozen=True)
class Certified:
    """The calibration that a session gave, in use; `new` unless it was before."""

    number: int
    new: bool
    calibration: Calibration

    @property
    def valid_from(self) -> datetime | None:
        """From when on it is used; None where nobody knows when its session was."""
        return known_time(self.calibration.valid_from)


@use_case(Right.CERTIFY, confirm=True)
def certify(
    services: Services, session: str, valid_from: datetime | None = None, *, despite_warnings: bool = False
) -> Certified:
    """Take the calibration that a session gave into use.

    Parameters
    ----------
    valid_from
        From when on it is used; from the session's beginning if it is None.
    despite_warnings
        Whether it is taken though it has warnings.

    Raises
    ------
    NotFound
        There is no such session, or it has given no calibration.
    InvalidInput
        The campaign is no session.
    Conflict
        It has warnings, or contradicts what is in use.
    """
    from sms_jobs.jobs.archiving import calibrations

    return Certified(
        *calibrations.certify(
            services.catalogue,
            services.archive,
            session,
            valid_from,
            datetime.now(UTC),
            despite_warnings=despite_warnings,
            signed=_signed(services),
        )
    )


def _signed(services: Services) -> Signed:
    from sms_jobs.records.calibration import Signed

    return Signed(services.actor.name, services.actor.reason)


@dataclass(frozen=True)
class Compared:
    """What changed between two calibrations, and from which change of points in mm on it matters."""

    comparison: CalibrationComparison
    tolerance_mm: float


@use_case(Right.READ)
def compare(services: Services, before: int, after: int, tolerance_mm: float | None = None) -> Compared:
    """Say what changed between two calibrations of a rig, and whether it matters.

    Parameters
    ----------
    tolerance_mm
        Change of points from which on it matters; what the earlier lets expect if it is None.

    Raises
    ------
    NotFound
        There is no such calibration.
    InvalidInput
        They are not of the same sensors.
    """
    from sms_jobs.jobs.archiving import calibrations

    return Compared(*calibrations.compare(services.catalogue, services.archive, before, after, tolerance_mm))


@use_case(Right.COMPUTE)
def check(
    services: Services, tuples: Sequence[str], *, baseline_mm: float = 0.01, false_alarm: float = 0.001
) -> list[CalibrationCheck]:
    """Decide from ordinary measurements, by their ray gaps, whether the calibration still holds.

    Parameters
    ----------
    tuples
        As campaign/state/view, whose shape has been measured.
    baseline_mm
        Systematic gap that is usual for the rig.
    false_alarm
        Probability that a calibration that holds is said to have drifted.

    Raises
    ------
    NotFound
        A tuple has no shape.
    InvalidInput
        It is no tuple.
    """
    from sms_jobs.jobs.archiving import calibrations

    now = datetime.now(UTC)
    return [
        calibrations.check(
            services.catalogue,
            services.archive,
            Subject.parse(text),
            now,
            baseline_mm=baseline_mm,
            false_alarm=false_alarm,
        )
        for text in tuples
    ]


@dataclass(frozen=True)
class Decision:
    """A calibration after somebody decided what it is used for; `new` unless it was so before."""

    calibration: CalibrationView
    new: bool


@use_case(Right.CERTIFY, confirm=True)
def decide(services: Services, number: int, campaign: str | None, *, in_use: bool) -> Decision:
    """Take a calibration into use for its rig, or for one campaign; or use it no longer.

    Raises
    ------
    NotFound
        There is no such calibration or campaign.
    Conflict
        It is of other sensors.
    """
    from sms_jobs.jobs.archiving import acceptances

    new = acceptances.accept(
        services.catalogue,
        services.archive,
        number,
        campaign,
        datetime.now(UTC),
        in_use=in_use,
        signed=_signed(services),
    )
    with services.catalogue.reading() as session:
        return Decision(search.calibration_view(session, number), new)


def style_for(out: Path, style: str | None) -> str:
    """Return the style of a file: the one that is asked for, else the only one whose files end so.

    Raises `InvalidInput` for a style that is none, a file that ends otherwise, or one that may be of several.
    """
    listed = ", ".join(f"{name} (*{', *'.join(endings)})" for name, endings in _ENDINGS.items())
    if style is not None:
        _checked_style(style)
        if out.suffix not in _ENDINGS[style]:
            endings = " or ".join(_ENDINGS[style])
            raise InvalidInput(f"'{out}' must end in {endings} to be a file of {style}; there are {listed}")
        return style
    fitting = [name for name, endings in _ENDINGS.items() if out.suffix in endings]
    if not fitting:
        raise InvalidInput(f"'{out}' ends as no style does; end it as one of {listed}")
    if len(fitting) > 1:
        raise InvalidInput(
            f"'{out}' may be a file of {' or '.join(fitting)}; say which, as in "
            f"'sms calibration export NUMBER --as {fitting[0]}'"
        )
    return fitting[0]


def _checked_style(style: str) -> Style:
    styles: tuple[Style, ...] = get_args(Style)
    chosen = next((one for one in styles if one == style), None)
    if chosen is None:
        raise InvalidInput(f"the style should be one of {', '.join(STYLES)}, not '{style}'")
    return chosen


@dataclass(frozen=True)
class CalibrationText:
    """A calibration as a file of another program, and what that file cannot say."""

    text: str
    remarks: tuple[str, ...]


@use_case(Right.READ)
def export(services: Services, number: int, style: str, *, pixel_pitch_um: float = 5.0) -> CalibrationText:
    """Return a calibration as a file of another program, one of `STYLES`.

    Parameters
    ----------
    pixel_pitch_um
        Width of a pixel, where the file has millimetres on the chip.

    Raises
    ------
    InvalidInput
        There is no such style.
    NotFound
        There is no such calibration.
    """
    # OpenCV writes the files; no other function here needs it.
    from sms_jobs.formats.interchange.calibration_files import calibration_text
    from sms_jobs.kinds.products import CALIBRATED

    chosen = _checked_style(style)
    with services.catalogue.reading() as session:
        view = search.calibration_view(session, number)
    with services.archive.open(view) as dataset:
        calibration = CALIBRATED.read(dataset)
    text, remarks = calibration_text(calibration, chosen, pixel_pitch_um / 1000.0)
    return CalibrationText(text, remarks)


@dataclass(frozen=True)
class Imported:
    """A calibration that was brought in, what became of it, and what was assumed of its file."""

    registered: Registered
    calibration: Calibration
    remarks: tuple[str, ...]


@use_case(Right.COMPUTE)
def import_files(services: Services, files: Sequence[Path], given: Supplement) -> Imported:
    """Bring in a calibration that was made elsewhere, from a file or several that complete each other.

    Raises
    ------
    InvalidInput
        The files cannot be read, or do not say enough with what is given.
    Conflict
        The rig has other sensors.
    """
    from sms_jobs.formats.interchange.calibration_files import read_calibration
    from sms_jobs.jobs.archiving.registration import register_calibration

    found = read_calibration(files, given)
    registered = register_calibration(
        services.catalogue,
        services.archive,
        found.calibration,
        datetime.now(UTC),
        signed=_signed(services),
    )
    return Imported(registered, found.calibration, found.remarks)
