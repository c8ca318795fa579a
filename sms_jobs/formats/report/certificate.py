"""What a report says of the calibration that it rests on, and of the recordings themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from math import isfinite

import numpy as np

from sms_jobs.formats.report.html import Cell, Markup, facts, number, paragraph, table
from sms_jobs.formats.report.tables import PER_CENT, local_time
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.recording import Recording
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.shown.times import known_time

_MICROMETRES = 1e3


def calibration_summary(calibration: Calibration, quality: CalibrationQuality | None) -> list[Markup]:
    """Say which calibration it is, how accurate it is, and what speaks against it."""
    box = calibration.volume
    span = " x ".join(f"{high - low:.0f}" for low, high in zip(box.low, box.high, strict=True))
    entries = [
        ("rig", calibration.rig.name),
        ("origin", calibration.origin),
        ("valid from", local_time(known_time(calibration.valid_from)) or "not known"),
        ("sensors", ", ".join(s.name for s in calibration.rig.sensors)),
        ("volume", f"{span} mm, diagonal {number(box.diagonal_mm)} mm"),
    ]
    if quality is None:
        words = "Nothing is known of its uncertainty: it came without a record of its adjustment."
        return [facts(entries), paragraph(words)]
    held_out = quality.held_out_bar_rms_mm()
    if isfinite(held_out) and held_out > 0.0:
        part = box.diagonal_mm / held_out
        entries.append(
            ("held-out bar lengths", f"{_MICROMETRES * held_out:.1f} µm rms, 1/{part:,.0f} of the diagonal")
        )
    entries.append(("world", quality.gauge))
    entries.append(("adjustment", f"{quality.residuals:,} residuals, {quality.iterations} iterations"))
    rows: list[list[Cell]] = []
    for view, sigma in zip(quality.views, quality.expected_sigma, strict=True):
        known = _MICROMETRES * sigma[np.isfinite(sigma)]
        if known.size:
            rows.append([view, *(float(v) for v in np.percentile(known, (0.0, 50.0, 100.0)))])
    header = ["view", "least [µm]", "median [µm]", "largest [µm]"]
    words = "Standard deviation of a point from the calibration alone; the camera's noise comes on top of it."
    return [facts(entries), *([paragraph(words), table(header, rows)] if rows else [])]


def recordings(found: Mapping[str, Recording]) -> list[Markup]:
    """List what the instruments' own check said of every recording, by tuple."""
    rows: list[list[Cell]] = [
        [
            where,
            PER_CENT * one.verdict.lit_fraction,
            PER_CENT * one.verdict.saturated_fraction,
            PER_CENT * one.verdict.modulation,
            one.retaken,
            one.recordings,
            "; ".join(one.verdict.doubts) or "none",
        ]
        for where, one in found.items()
    ]
    header = [
        "recording",
        "lit [%]",
        "saturated [%]",
        "modulation or contrast [% of full scale]",
        "retaken",
        "sets",
        "doubts",
    ]
    return [table(header, rows)]


def doubts(
    warnings: Sequence[str], what: str = "What to look at before these numbers are used"
) -> list[Markup]:
    """Set what speaks against a result apart; nothing where nothing does."""
    if not warnings:
        return []
    items = "".join(f"<li>{escape(warning)}</li>" for warning in warnings)
    return [
        Markup(
            f'<div class="doubts" role="note"><p><strong>{escape(what)}</strong></p><ul>{items}</ul></div>'
        )
    ]


def doubts_of(quality: CalibrationQuality | None, found: Mapping[str, Recording]) -> Iterable[str]:
    """Yield what a calibration and recordings say against themselves."""
    if quality is not None:
        yield from (f"Calibration: {warning}" for warning in quality.warnings)
    for where, one in found.items():
        yield from (f"Recording {where}: {doubt}" for doubt in one.verdict.doubts)
