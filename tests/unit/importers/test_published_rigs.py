"""Frames of two other makers' rigs, as they are published: layouts are guessed, and phases make sense."""

from __future__ import annotations

from datetime import UTC, datetime
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sms_jobs.formats.importers.folders import list_folder
from sms_jobs.formats.importers.frames import arrange
from sms_jobs.formats.importers.guess import guess_layout
from sms_jobs.formats.importers.inspection import camera_models, inspect, measurement_of
from sms_jobs.formats.importers.layout import layout_of
from sms_jobs.kinds.shape.code_watch import CodeFinding, check_code
from sms_jobs.kinds.shape.foreign_patterns import coarse_gradient, offsets_of
from sms_jobs.kinds.shape.frame_lines import FrameLines
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.records.measurement import Measurement

FOLDER = Path(__file__).resolve().parents[4] / "shared" / "data" / "fringe"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"put the published fringe images into {FOLDER} for these tests"
)


def measured(folder: Path, given: dict[str, Any]) -> tuple[dict[str, Any], Measurement]:
    """Import a folder of one tuple by a guess."""
    listing = list_folder(folder)
    guess = guess_layout(listing, given, None)
    layout = layout_of(guess.table, "the guess")
    (found,) = arrange(listing, layout).tuples
    one = inspect(listing.folder, found, layout.raw, layout.full_scale, sequence=layout.sequence)
    assert not one.found.faults
    camera = camera_models([one], layout)[0][0]
    return guess.table, measurement_of(listing.folder, one, layout, camera, datetime(2020, 1, 1, tzinfo=UTC))


def gradient(measurement: Measurement, rows: slice) -> PhaseGradient:
    frames = measurement.frames.rows(rows.start, rows.stop)
    return unwrap(
        frames[measurement.sequence.frames_of(0)],
        measurement.sequence.densities,
        measurement.sequence.steps,
        full_scale=measurement.full_scale,
        gain=measurement.gain,
        read_noise=measurement.read_noise,
        offsets=offsets_of(measurement),
        coarse=coarse_gradient(measurement, 0, frames),
    )


def test_twelve_steps_and_gray_code_of_slmaster() -> None:
    table, measurement = measured(
        FOLDER / "slmaster_mono",
        {"sequence": {"densities": (32,)}, "phase": {"origin": "edge", "offset_deg": 180.0}},
    )
    assert (table["pattern"], table["frames"]) == ("L/{number}.png", "fringes gray")
    assert (table["sequence"]["steps"], table["gray"]["bits"]) == (12, 6)
    rows = slice(480, 620)
    found = gradient(measurement, rows)
    lit = found.modulation > 20.0
    assert lit.sum() > 40_000
    # Fringe and code agree: the few others are at shadows and at the rim.
    assert found.ambiguous[lit].mean() < 0.01
    # A wrong frame order, direction or offset makes jumps of a fringe, 0.2 rad, all over a smooth surface.
    good = lit & ~found.ambiguous & ~found.saturated
    steps = np.diff(np.where(good, found.omega, np.nan), axis=1)
    assert np.nanpercentile(np.abs(steps), 99.0) < 0.1 * 2.0 * pi / 32
    assert np.nanmedian(steps) > 0.0


def found_in(measurement: Measurement) -> CodeFinding | None:
    rows, columns = measurement.frames.shape[1:]
    lines = FrameLines(rows, columns)
    lines.take(slice(0, rows), measurement.frames.rows(0, rows))
    return check_code(measurement, lines.stacked(), 0.02, None)


@pytest.mark.parametrize(
    ("density", "offset_deg", "said"),
    [
        (32, 180.0, ""),
        (31, 180.0, "along 0 deg 31 fringes are stated, but the phases are those of 32"),
        (32, 0.0, "along 0 deg the fringes lie 3.1 rad beside the code, and 0.26 rad are accepted"),
    ],
)
def test_fringes_and_code_of_slmaster_belong_together(density: int, offset_deg: float, said: str) -> None:
    told = {"sequence": {"densities": (density,)}, "phase": {"origin": "edge", "offset_deg": offset_deg}}
    found = found_in(measured(FOLDER / "slmaster_mono", told)[1])
    assert (found is None) == (said == "")
    assert found is None or said in found.text


def test_two_densities_of_slstudio() -> None:
    folder, sequence = FOLDER / "slstudio_skull" / "skull_2x3", {"densities": (16, 1)}
    table, measurement = measured(
        folder, {"sequence": sequence, "phase": {"origin": "edge", "direction": -1}}
    )
    assert (table["pattern"], table["frames"]) == ("frameSeq_{number}.png", "fringes")
    assert table["sequence"]["steps"] == 3
    assert measurement.phase_offsets_rad == pytest.approx((0.0, pi))
    found = gradient(measurement, slice(500, 640))
    lit = found.modulation > 40.0
    assert lit.sum() > 20_000
    # From 1 to 16 fringes at once takes a modulation of some 50 times the noise: some of the darker are lost.
    assert found.ambiguous[lit].mean() < 0.06
    good = lit & ~found.ambiguous & ~found.saturated
    steps = np.diff(np.where(good, found.omega, np.nan), axis=1)
    assert np.nanpercentile(np.abs(steps), 99.0) < 0.1 * 2.0 * pi / 16
