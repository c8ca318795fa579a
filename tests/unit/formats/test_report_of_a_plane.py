"""What a report shows of a camera alone."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from support.planes import SIGMA_PX, merged_in_plane, moved_in_plane, one_region, plane, strain_in_plane

from sms_jobs.formats.report.surface import deformed_view, reference_view
from sms_jobs.formats.report.view import Sampler, View
from sms_jobs.kinds.reporting import report
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject

SHAPE = (48, 80)
SAMPLER = Sampler(SHAPE, 40, 0)


def surface(mm_per_px: float | None = None) -> Surface:
    """Return a specimen that begins at column 16."""
    reason = np.zeros(SHAPE, np.uint32)
    reason[:, :16] = Reason.NO_TEXTURE
    return plane(reason, mm_per_px)


def view(mm_per_px: float | None = None) -> View:
    """Return a motion by 1 px to the right and 2 px downwards, and a strain."""
    own = surface(mm_per_px)
    moved = moved_in_plane(own, np.full(SHAPE, 1.0), np.full(SHAPE, 2.0))
    return deformed_view(merged_in_plane(own, moved), "C1", strain_in_plane(own), SAMPLER)


def shown(of: View) -> dict[str, Any]:
    return {field.name: field for field in of.fields}


def numbers(of: View) -> dict[str, float | None]:
    return {f"{one.group} {one.name}".strip(): one.value for one in of.statistics}


@pytest.mark.parametrize(("mm_per_px", "unit", "scale"), [(None, "px", 1.0), (0.05, "mm", 0.05)])
def test_y_points_up_and_lengths_have_the_scale(mm_per_px: float | None, unit: str, scale: float) -> None:
    found = view(mm_per_px)
    fields = shown(found)
    assert fields["displacement X"].unit == fields["displacement Y"].unit == unit
    assert np.nanmax(fields["displacement X"].values) == pytest.approx(scale)
    # Two pixels downwards in the image.
    assert np.nanmax(fields["displacement Y"].values) == pytest.approx(-2.0 * scale)
    assert np.nanmax(fields["displacement Y"].sigma) == pytest.approx(2.0 * SIGMA_PX * scale)
    assert "displacement Z" not in fields
    assert found.position is None
    assert found.movement is None
    assert numbers(found)["Displacement valid"] == pytest.approx(80.0)
    assert numbers(found)["Strain yy, median"] == pytest.approx(1000.0)
    assert found.mm_per_px == mm_per_px
    assert ("2 mm (40 px)" if mm_per_px else "gauge length of 40 px.") in found.notes[0]


def test_the_reference_tells_of_its_texture(rng: np.random.Generator) -> None:
    levels = rng.integers(50, 150, SHAPE).astype(np.uint16)
    levels[0, 0] = 255
    when = datetime(2026, 1, 1, tzinfo=UTC)
    measurement = Measurement(when, FringeSequence(), 255, 0.04, 0.0, levels, ArrayStack(levels[None]))
    own = surface()
    told = numbers(reference_view("C1", measurement, own, one_region(own), SAMPLER))
    mean = levels[:, 16:].mean()
    assert told["mean grey level"] == pytest.approx(mean)
    assert told["noise there"] == pytest.approx(np.sqrt(0.04 * mean))
    # White noise is its own speckle: the autocorrelation falls to a half within half a pixel.
    assert told["speckle, full width at half maximum"] == pytest.approx(1.0, abs=0.1)
    assert told["saturated"] == pytest.approx(100.0 / levels.size)
    assert not {"extent Z", "sigma Z, median"} & set(told)
    lost = plane(np.full(SHAPE, Reason.NO_TEXTURE, np.uint32))
    assert (
        numbers(reference_view("C1", measurement, lost, one_region(lost), SAMPLER))[
            "speckle, full width at half maximum"
        ]
        is None
    )


def test_where_nothing_was_found_there_is_a_view_all_the_same() -> None:
    own = surface()
    gone = np.full(SHAPE, Reason.NO_MATCH, np.uint32)
    nothing = moved_in_plane(own, np.zeros(SHAPE), np.zeros(SHAPE), gone)
    lost = deformed_view(merged_in_plane(own, nothing), "C1", strain_in_plane(own), SAMPLER)
    assert numbers(lost)["Displacement X, median"] is None


def test_a_report_of_a_camera_alone_wants_no_calibration() -> None:
    states = tuple(LoadState(label) for label in ("00", "01"))
    campaign = Campaign("coupon", Specimen("coupon"), "camera", states, ("C1",))
    needs = report.KIND.checked_needs(campaign, Subject("coupon"), report.ReportParameters())
    sources = [need.source for need in needs]
    assert sorted(sources) == ["correlate", "measurement", "measurement", "merge", "plane", "strain"]
