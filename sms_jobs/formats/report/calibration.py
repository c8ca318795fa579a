"""The page about a calibration: how accurate it is, and what a person should look at before it is used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sms_jobs.formats.calibration_figures import draw_expected_sigma, draw_residuals
from sms_jobs.formats.report.certificate import doubts
from sms_jobs.formats.report.charts import Axis, Chart, Line, Point, charts
from sms_jobs.formats.report.html import Cell, Markup, facts, figure, figures, paragraph, table
from sms_jobs.formats.report.page import Section, page
from sms_jobs.metrology.geometry.camera import PER_POSE
from sms_jobs.metrology.geometry.lens import LENS
from sms_jobs.records.calibration import CalibrationQuality, CalibrationUncertainty
from sms_jobs.records.sensors import Calibration, Rig, Sensor
from sms_jobs.records.shown.times import with_unknown_times

MICROMETRES = 1e3


def calibration_page(
    session: str,
    before: Rig,
    calibration: Calibration,
    uncertainty: CalibrationUncertainty,
    quality: CalibrationQuality,
    width_px: int,
    closing: Sequence[Section] = (),
) -> str:
    """Return the page about the calibration that a session gave; `before` is what it began with.

    `closing` are the last sections: where it comes from.
    """
    sections = [
        Section("In short", [_summary(calibration, quality)]),
        Section("Expected standard deviation of a point", _expected(quality, width_px)),
        Section("Poses that took no part", _held_out(quality, calibration.volume.diagonal_mm)),
        Section(
            "Residuals",
            [
                *_by("what they are", quality.rms_by_type),
                *_by("sensor, in units of the stated deviation", quality.rms_by_sensor),
                *_by("pose, in units of the stated deviation", quality.rms_by_pose),
                _residual_maps(calibration.rig, quality, width_px),
            ],
        ),
        Section("Left out", _refused(quality.refused)),
        Section("Parameters", [_parameters(before, calibration.rig, uncertainty)]),
        *closing,
    ]
    introduction = paragraph(
        "Deviations are one standard deviation. What is called expected comes from the calibration alone; "
        "the noise of a measurement comes on top of it.",
        faint=True,
    )
    about = [introduction, *_warnings(quality)]
    return page(f"Calibration session {session}", about, sections)


def _summary(calibration: Calibration, quality: CalibrationQuality) -> Markup:
    diagonal = calibration.volume.diagonal_mm
    held_out = quality.held_out_bar_rms_mm()
    lengths = ""
    if np.isfinite(held_out) and held_out > 0.0:
        lengths = (
            f"{MICROMETRES * held_out:.1f} µm rms, 1/{diagonal / held_out:,.0f} of the volume's diagonal of "
            f"{diagonal:.1f} mm"
        )
    size = f"{quality.residuals:,} residuals, {quality.parameters} parameters"
    return facts(
        [
            ("rig", calibration.rig.name),
            ("sensors", ", ".join(s.name for s in calibration.rig.sensors)),
            ("world", quality.gauge),
            ("scale", quality.scale),
            ("shape, scale apart", _shape(quality, diagonal)),
            ("began with", with_unknown_times(quality.started_from)),
            ("adjustment", f"{size}, {quality.iterations} iterations"),
            ("held-out bar lengths", lengths),
            *((name, f"{value:.6g}") for name, value in quality.labelled().items()),
        ]
    )


def _shape(quality: CalibrationQuality, diagonal: float) -> str:
    """Say how well points lie to each other, whatever the scale."""
    sigma = quality.shape_sigma_mm
    if not sigma:
        return ""
    return f"{MICROMETRES * sigma:.3g} µm for a point, 1/{diagonal / sigma:,.0f} of the volume's diagonal"


def _warnings(quality: CalibrationQuality) -> list[Markup]:
    if not quality.warnings:
        return [paragraph("Nothing speaks against using this calibration.")]
    return doubts(quality.warnings, "What to look at before this calibration is used")


def _expected(quality: CalibrationQuality, width_px: int) -> list[Markup]:
    rows: list[list[Cell]] = []
    pictures = []
    for view, sigma in zip(quality.views, quality.expected_sigma, strict=True):
        known = sigma[np.isfinite(sigma)]
        if not known.size:
            continue
        low, middle, high = MICROMETRES * np.percentile(known, (0.0, 50.0, 100.0))
        rows.append([view, float(low), float(middle), float(high)])
        seen = np.isfinite(sigma)
        drawn = draw_expected_sigma(quality.place[seen], sigma[seen], view, width_px)
        pictures.append(figure(drawn, f"Expected standard deviation of a point of {view}, three levels of Z"))
    header = ["view", "least [µm]", "median [µm]", "largest [µm]"]
    return [table(header, rows), figures(pictures)]


def _held_out(quality: CalibrationQuality, diagonal_mm: float) -> list[Markup]:
    parts = [
        paragraph("Each pose is left out once, the rest is adjusted again, and the result measures the pose.")
    ]
    if quality.bar_length_error_mm:
        rows: list[list[Cell]] = [
            [pose, MICROMETRES * error, diagonal_mm / abs(error) if error else None]
            for pose, error in quality.bar_length_error_mm.items()
        ]
        parts.append(_over_poses("length error of the bar", "µm", quality.bar_length_error_mm, MICROMETRES))
        parts.append(table(["pose of the bar", "length error [µm]", "diagonal / error"], rows))
    if quality.board_rms_px:
        boards: list[list[Cell]] = [[pose, rms] for pose, rms in quality.board_rms_px.items()]
        parts.append(_over_poses("residuals of the board, rms", "px", quality.board_rms_px, 1.0))
        parts.append(table(["pose of the board", "rms [px]"], boards))
    return parts


def _over_poses(what: str, unit: str, found: Mapping[str, float], scale: float) -> Markup:
    """Chart what each pose was found to be, in order."""
    points = tuple(Point(pose, scale * value) for pose, value in found.items() if np.isfinite(value))
    along = Axis("pose", {pose: float(place) for place, pose in enumerate(found)}, names=True)
    return charts([Chart(what, unit, (Line("left out, measured by the rest", points),))], [along])


def _by(what: str, rms: Mapping[str, float]) -> list[Markup]:
    rows: list[list[Cell]] = [[name, value] for name, value in rms.items()]
    return [table([f"by {what}", "rms"], rows)] if rows else []


def _residual_maps(rig: Rig, quality: CalibrationQuality, width_px: int) -> Markup:
    pictures = []
    for number, sensor in enumerate(rig.sensors):
        mine = quality.residual_sensor == number
        if mine.any():
            size = (sensor.rows, sensor.columns)
            drawn = draw_residuals(
                quality.residual_px[mine], quality.residual[mine], size, sensor.name, width_px
            )
            pictures.append(figure(drawn, f"Residuals of board points in {sensor.name}"))
    return figures(pictures)


def _refused(refused: Mapping[str, int]) -> list[Markup]:
    if not any(refused.values()):
        return [paragraph("No observation was left out.")]
    rows: list[list[Cell]] = [[why, count] for why, count in refused.items() if count]
    return [table(["reason", "observations"], rows)]


def _parameters(before: Rig, after: Rig, uncertainty: CalibrationUncertainty) -> Markup:
    rows: list[list[Cell]] = []
    for sensor in after.sensors:
        first = before.sensor(sensor.name)
        inner = np.sqrt(np.diag(uncertainty.of([sensor.name])))[PER_POSE:]
        values = zip(first.intrinsics.vector(), sensor.intrinsics.vector(), inner, strict=True)
        for (name, known), (old, new, sigma) in zip(LENS.items(), values, strict=True):
            unit = f" [{known.unit}]" if known.unit != "1" else ""
            what = f"{name}, {known.meaning}{unit}"
            rows.append([sensor.name, what, float(old), float(new), float(sigma) if sigma else "held"])
        for axis, old, new in zip("XYZ", _pin_hole(first), _pin_hole(sensor), strict=True):
            rows.append([sensor.name, f"pin-hole {axis} [mm]", old, new, None])
    return table(["sensor", "parameter", "before", "after", "standard deviation"], rows)


def _pin_hole(sensor: Sensor) -> list[float]:
    return [float(x) for x in sensor.pose.centre()]
