"""Calibrations of rigs: taken into use, compared, and checked against what was measured with them.

What computes is imported by the functions that compute: many read a calibration that compare none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive, InputReference
from sms_jobs.archive.dataset import ArchivedDataset
from sms_jobs.catalogue import campaigns, search, subject_files, valid_calibrations
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import Conflict, InvalidInput, NotFound
from sms_jobs.jobs.archiving import calibration_choice
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.kinds.calibration.sessions import CALIBRATE, CALIBRATE_BOARDS, bar_states
from sms_jobs.kinds.products import CALIBRATED, PHASE, QUALITY, SURFACE, UNCERTAINTY
from sms_jobs.records.calibration import NOBODY, CalibrationQuality, CalibrationUncertainty, Signed
from sms_jobs.records.fields import PhaseMaps, Surface
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Box, Calibration, Rig
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sms_jobs.metrology.calibration.checking.comparison import CalibrationComparison
    from sms_jobs.metrology.calibration.checking.drift import DriftCheck
    from sms_jobs.metrology.calibration.pair_points import Parameters

_HIDDEN_BY_DRIFT = Reason.LARGE_RAY_GAP | Reason.OUT_OF_VOLUME
"""Reasons for which a pixel is refused when a sensor has moved: a drift must not hide itself."""


@dataclass(frozen=True)
class KnownCalibration:
    """A calibration and what is known of it; nothing is known of one that was brought in."""

    number: int | None
    path: str
    calibration: Calibration
    uncertainty: CalibrationUncertainty | None
    quality: CalibrationQuality | None

    def parameters(self) -> dict[str, Parameters]:
        """Return inner parameters and pose of every sensor, by name."""
        return {s.name: (s.intrinsics, s.pose) for s in self.calibration.rig.sensors}

    def covariance(self, names: list[str]) -> np.ndarray | None:
        """Return the covariance of some sensors' parameters, in that order; None when it is not known."""
        return None if self.uncertainty is None else self.uncertainty.of(names)


def known_calibration(catalogue: Catalogue, archive: Archive, number: int) -> KnownCalibration:
    """Read a calibration of the catalogue; raise `NotFound` where there is none of that number."""
    with catalogue.reading() as session:
        view = search.calibration_view(session, number)
    with archive.open(view) as dataset:
        return _known(number, view.path, dataset)


def _known(number: int | None, path: str, dataset: ArchivedDataset) -> KnownCalibration:
    return KnownCalibration(
        number,
        path,
        CALIBRATED.read(dataset),
        UNCERTAINTY.read_if_there(dataset),
        QUALITY.read_if_there(dataset),
    )


def session_result(
    catalogue: Catalogue, archive: Archive, campaign: str
) -> tuple[FileView, KnownCalibration]:
    """Read the newest calibration that a session gave: with its ball bar, or from boards where it has none.

    Raises `NotFound` where the session has given none, `InvalidInput` for a campaign that is no session.
    """
    with catalogue.reading() as session:
        definition = campaigns.definition(campaigns.campaign_row(session, campaign))
        if definition.session is None:
            raise InvalidInput(
                f"campaign {campaign} is no calibration session; 'sms campaign create --example-session' and "
                "'sms import boards' make sessions"
            )
        subject = Subject(campaign)
        # A session with a ball bar is not done before the bar has taken part.
        kind = CALIBRATE if bar_states(definition) else CALIBRATE_BOARDS
        files = search.find_files(session, source=kind, campaign=campaign, limit=20)
        datasets = [f for f in files if f.subject == str(subject) and f.media_type == DATASET_MEDIA_TYPE]
    if not datasets:
        raise NotFound(
            f"session {campaign} has given no calibration yet; run 'sms job submit pipeline -c {campaign}' "
            "when its poses have been recorded"
        )
    with archive.open(datasets[0]) as dataset:
        return datasets[0], _known(None, datasets[0].path, dataset)


def certify(
    catalogue: Catalogue,
    archive: Archive,
    campaign: str,
    valid_from: datetime | None,
    now: datetime,
    *,
    despite_warnings: bool = False,
    signed: Signed = NOBODY,
) -> tuple[int, bool, Calibration]:
    """Take the calibration that a session gave into use.

    Parameters
    ----------
    campaign
        Name of the session.
    valid_from
        From when on it is used; from the session's beginning if None.
    despite_warnings
        Whether a calibration is taken that has warnings.
    signed
        Who certifies it.

    Returns
    -------
    Its number, whether it is new, and the calibration.

    Raises
    ------
    NotFound
        The session has given none.
    InvalidInput
        The campaign is no session.
    Conflict
        It has warnings, and nobody has said that it is to be used all the same.
    """
    file, found = session_result(catalogue, archive, campaign)
    assert found.quality is not None
    if found.quality.warnings and not despite_warnings:
        listed, count = "; ".join(found.quality.warnings), len(found.quality.warnings)
        raise Conflict(
            f"the calibration of session {campaign} has {count} warning{'s' * (count != 1)} and is "
            f"not taken into use: {listed}; see its report, or set `despite_warnings`"
        )
    since = valid_from or _began(catalogue, campaign, found.calibration)
    calibration = replace(found.calibration, valid_from=since)
    known = register_calibration(
        catalogue,
        archive,
        calibration,
        now,
        inputs=(InputReference("session", file.source, file.path, file.content_hash),),
        beside={UNCERTAINTY: found.uncertainty, QUALITY: found.quality},
        accepted=True,
        signed=signed,
    )
    return known.number, known.new, calibration


def _began(catalogue: Catalogue, campaign: str, calibration: Calibration) -> datetime:
    """Return when a session began: as its plan says, or when its first pose was recorded."""
    if calibration.valid_from != UNTIMED:
        return calibration.valid_from
    with catalogue.reading() as session:
        number = campaigns.campaign_id(session, campaign)
        return valid_calibrations.session_began(session, number) or UNTIMED


def deviation_from(rig: Rig, calibration: Calibration) -> dict[str, float]:
    """Return by how much points of each view are off, rms over the volume in mm, if `rig` is the truth."""
    from sms_jobs.metrology.calibration.checking.comparison import compare_calibrations

    found = compare_calibrations(
        {s.name: (s.intrinsics, s.pose) for s in rig.sensors},
        {s.name: (s.intrinsics, s.pose) for s in calibration.rig.sensors},
        _measuring(rig),
        _corners(calibration.volume),
        tolerance_mm=calibration.volume.diagonal_mm,
    )
    return {f"{p.camera}{p.projector}": p.rms_mm for p in found.pairs}


def compare(
    catalogue: Catalogue, archive: Archive, before: int, after: int, tolerance_mm: float | None
) -> tuple[CalibrationComparison, float]:
    """Say what changed between two calibrations of a rig, and whether it matters.

    Returns
    -------
    The comparison, and the tolerance in mm that it was made with: what is given, or what the earlier
    calibration lets expect of a point, at least 1/50,000 of the volume's diagonal.

    Raises
    ------
    InvalidInput
        They are not of the same sensors.
    """
    old, new = (known_calibration(catalogue, archive, n) for n in (before, after))
    return compared(old, new, tolerance_mm)


def _measuring(rig: Rig) -> list[tuple[str, str]]:
    """Return the sensors of every view: every camera with every projector, else with every other camera."""
    return [(view.camera, view.partners[0]) for view in map(view_of, rig.views())]


def measuring_pairs(rig: Rig) -> list[tuple[str, str]]:
    """Return the pairs of sensors that measure points: of camera and projector, else of cameras.

    Raises `InvalidInput` for a rig of one sensor.
    """
    pairs = _measuring(rig) or [*combinations((s.name for s in rig.sensors), 2)]
    if not pairs:
        raise InvalidInput(
            f"rig {rig.name} has one sensor, which alone measures no points: see its parameters in 'sms "
            "calibration show'"
        )
    return pairs


def compared(
    old: KnownCalibration, new: KnownCalibration, tolerance_mm: float | None
) -> tuple[CalibrationComparison, float]:
    """Return what `compare` does, of calibrations that are at hand."""
    from sms_jobs.kinds.calibration.session_adjustment import known_as
    from sms_jobs.metrology.calibration.checking.comparison import compare_calibrations

    _refuse_other_sizes(old.calibration.rig, new.calibration.rig)
    if tolerance_mm is None:
        tolerance_mm = old.calibration.volume.diagonal_mm / 50_000.0
        if old.quality is not None and np.isfinite(old.quality.expected_sigma).any():
            expected = float(np.sqrt(np.nanmean(old.quality.expected_sigma**2)))
            tolerance_mm = max(tolerance_mm, expected)
    names = [s.name for s in old.calibration.rig.sensors]
    earlier, later = old.covariance(names), new.covariance(names)
    both = earlier is not None and later is not None
    began_from_it = new.quality is not None and new.quality.started_from == known_as(old.calibration)
    comparison = compare_calibrations(
        old.parameters(),
        new.parameters(),
        measuring_pairs(old.calibration.rig),
        _corners(old.calibration.volume),
        covariance_before=earlier if both else None,
        covariance_after=later if both else None,
        relation="lenses updated" if began_from_it else "independent",
        # Each session has a world of its own, that of its first board or of its first sensor.
        same_world=False,
        tolerance_mm=tolerance_mm,
    )
    return comparison, tolerance_mm


def _refuse_other_sizes(old: Rig, new: Rig) -> None:
    """Raise `InvalidInput` where a sensor has another number of pixels: it is another sensor."""
    later = {s.name: (s.columns, s.rows) for s in new.sensors}
    for sensor in old.sensors:
        size = later.get(sensor.name)
        if size is not None and size != (sensor.columns, sensor.rows):
            raise InvalidInput(
                f"{sensor.name} has {sensor.columns} x {sensor.rows} px in the earlier calibration and "
                f"{size[0]} x {size[1]} px in the later one: compare those of the same sensors"
            )


@dataclass(frozen=True)
class CalibrationCheck:
    """Whether a calibration holds for a tuple that was measured."""

    subject: str
    calibration: int
    check: DriftCheck


def check(
    catalogue: Catalogue,
    archive: Archive,
    subject: Subject,
    now: datetime,
    *,
    baseline_mm: float,
    false_alarm: float,
    threads: int = 1,
) -> CalibrationCheck:
    """Decide by the ray gap of a tuple whether the calibration that is valid for it still holds.

    Raises
    ------
    InvalidInput
        `subject` is no tuple of a camera and a projector.
    NotFound
        The tuple has no shape yet, or no calibration is valid for it.
    """
    if subject.view is None or subject.state is None:
        raise InvalidInput(f"'{subject}' is no tuple; write campaign/state/view, such as wing/S01/C1P2")
    if view_of(subject.view).other_cameras:
        raise InvalidInput(
            f"{subject} is measured by several cameras, whose jobs tell their own ray gaps "
            "('sms data find --columns subject,ray_gap_rms_mm'): check a camera and a projector, as C1P2"
        )
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, subject.campaign)
        orientations = campaigns.definition(row).sequence
        if len(orientations.orientations_rad) < 2:
            raise InvalidInput(
                f"{subject} has fringes of one orientation, with which no error of the calibration shows: "
                "check a measurement with two orientations"
            )
        shape = subject_files.newest_file(session, "reconstruct", subject, DATASET_MEDIA_TYPE)
        used = calibration_choice.chosen(session, subject, now)
        if shape is None or used is None:
            what = "shape" if shape is None else "valid calibration"
            raise NotFound(f"{subject} has no {what} yet; 'sms job submit reconstruct' makes shapes")
        view, number = search.file_view(session, str(shape)), used.number
    known = known_calibration(catalogue, archive, number)
    with archive.open(view) as dataset:
        phase, cloud = PHASE.read(dataset), SURFACE.read(dataset)
    return CalibrationCheck(
        str(subject),
        number,
        drift_of(known, subject.view, orientations, phase, cloud, baseline_mm, false_alarm, threads),
    )


def drift_of(
    known: KnownCalibration,
    view: str,
    sequence: FringeSequence,
    phase: PhaseMaps,
    cloud: Surface,
    baseline_mm: float,
    false_alarm: float,
    threads: int,
) -> DriftCheck:
    """Return what `check` does, of a measurement and a calibration that are at hand."""
    from sms_jobs.kinds.shape.phases import sensor_pair
    from sms_jobs.metrology.calibration.checking.drift import DriftOptions, check_drift

    names = list(view_of(view).sensors)
    camera, projector = (known.calibration.rig.sensor(n) for n in names)
    refused = (cloud.reason & ~np.uint32(_HIDDEN_BY_DRIFT)) != 0
    omega = np.where(refused, np.nan, phase.omega)
    points = sensor_pair(camera, projector, sequence, threads).meet(omega, phase.omega_sigma)
    return check_drift(
        points.ray_gap,
        points.xyz,
        (camera.intrinsics, camera.pose),
        (projector.intrinsics, projector.pose),
        gap_sigma=points.ray_gap_sigma,
        baseline_rms_mm=baseline_mm,
        covariance=known.covariance(names),
        options=DriftOptions(false_alarm=false_alarm),
    )


def _corners(box: Box) -> tuple[np.ndarray, np.ndarray]:
    return np.array(box.low), np.array(box.high)
