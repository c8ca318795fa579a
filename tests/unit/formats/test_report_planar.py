"""What a report shows of a camera alone."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from sms_jobs.formats.report.planar import planar_view, texture_view
from sms_jobs.formats.report.view import Sampler, View
from sms_jobs.kinds import report
from sms_jobs.records.campaign import Campaign, LoadState, Specimen, Subject
from sms_jobs.records.fields import ImageMatches
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.planar import PlanarDisplacement, PlanarStrain
from sms_jobs.records.reasons import Reason

SHAPE = (48, 80)
SAMPLER = Sampler(SHAPE, 40, 0)


def records(mm_per_px: float | None = None) -> tuple[PlanarDisplacement, ImageMatches, PlanarStrain]:
    """Return a motion by 1 px to the right and 2 px downwards, and a strain, without the left columns."""
    reason = np.zeros(SHAPE, np.uint32)
    reason[:, :16] = Reason.NO_TEXTURE
    hole = np.where(reason == 0, 1.0, np.nan)
    sigma = np.stack([0.01 * hole, 0.02 * hole]).astype(np.float32)
    moved = PlanarDisplacement("C1", "00", 10, mm_per_px, np.stack([hole, 2.0 * hole]), sigma, reason)
    strain = PlanarStrain(
        "small",
        40.0,
        mm_per_px,
        np.stack([-3e-4 * hole, 1e-3 * hole, 2e-4 * hole]),
        np.stack([1e-5 * hole, 2e-5 * hole, 1e-5 * hole]).astype(np.float32),
        np.stack([1.03e-3 * hole, -3.3e-4 * hole]),
        1.2e-3 * hole,
        reason,
    )
    three = np.array([1.0, 2.0, 3.0])
    single = three.astype(np.float32)
    whole = np.ones(3, np.int32)
    lost = np.array([0, 0, Reason.NO_MATCH], np.uint32)
    gradient = np.zeros((4, 3))
    matches = ImageMatches(three, three, whole, three, three, gradient, single, single, single, whole, lost)
    return moved, matches, strain


def shown(view: View) -> dict[str, Any]:
    return {field.name: field for field in view.fields}


@pytest.mark.parametrize(("mm_per_px", "unit", "scale"), [(None, "px", 1.0), (0.05, "mm", 0.05)])
def test_y_points_up_and_lengths_have_the_scale(mm_per_px: float | None, unit: str, scale: float) -> None:
    view = planar_view(*records(mm_per_px), SAMPLER)
    fields = shown(view)
    assert fields["displacement x"].unit == fields["displacement y"].unit == unit
    assert np.nanmax(fields["displacement x"].values) == pytest.approx(scale)
    # Two pixels downwards in the image.
    assert np.nanmax(fields["displacement y"].values) == pytest.approx(-2.0 * scale)
    assert np.nanmax(fields["displacement y"].sigma) == pytest.approx(0.02 * scale)
    numbers = {one.name: one.value for one in view.statistics}
    assert numbers["points matched"] == pytest.approx(200.0 / 3.0)
    assert numbers["displacement valid"] == pytest.approx(80.0)
    assert numbers["strain yy, median"] == pytest.approx(1000.0)
    assert view.mm_per_px == mm_per_px
    assert ("2 mm (40 px)" if mm_per_px else "gauge length of 40 px.") in view.notes[0]


def test_the_deviation_of_a_principal_strain_is_that_of_many_trials(rng: np.random.Generator) -> None:
    *others, strain = records()
    fields = shown(planar_view(*others, strain, SAMPLER))
    noisy = strain.strain[:, 0, 40] + rng.normal(size=(4000, 3)) * strain.sigma[:, 0, 40]
    xx, yy, xy = noisy.T
    root = np.hypot(0.5 * (xx - yy), xy)
    for name, values in (("first", 0.5 * (xx + yy) + root), ("second", 0.5 * (xx + yy) - root)):
        stated = np.nanmedian(fields[f"{name} principal strain"].sigma)
        # The scatter of 4000 trials is known to 1.1 %: 5 % are more than four of its deviations.
        assert stated == pytest.approx(1e6 * values.std(), rel=0.05)


def test_the_reference_tells_of_its_texture(rng: np.random.Generator) -> None:
    levels = rng.integers(50, 150, SHAPE).astype(np.uint16)
    levels[0, 0] = 255
    when = datetime(2026, 1, 1, tzinfo=UTC)
    measurement = Measurement(when, FringeSequence(), 255, 0.04, 0.0, levels, ArrayStack(levels[None]))
    reason = records()[0].reason
    view = texture_view("C1", measurement, reason, SAMPLER)
    numbers = {one.name: one.value for one in view.statistics}
    mean = levels[:, 16:].mean()
    assert numbers["mean grey level"] == pytest.approx(mean)
    assert numbers["noise there"] == pytest.approx(np.sqrt(0.04 * mean))
    # White noise is its own speckle: the autocorrelation falls to a half within half a pixel.
    assert numbers["speckle, full width at half maximum"] == pytest.approx(1.0, abs=0.1)
    assert numbers["saturated"] == pytest.approx(100.0 / levels.size)
    nothing = np.full(SHAPE, Reason.NO_TEXTURE, np.uint32)
    lost = {one.name: one.value for one in texture_view("C1", measurement, nothing, SAMPLER).statistics}
    assert lost["speckle, full width at half maximum"] is None


def test_where_nothing_was_found_there_is_a_view_all_the_same() -> None:
    moved, matches, strain = records()
    gone = np.full(SHAPE, Reason.NO_MATCH, np.uint32)
    empty = replace(moved, displacement=np.full((2, *SHAPE), np.nan), reason=gone)
    view = planar_view(empty, replace(matches, reason=np.ones(3, np.uint32)), strain, SAMPLER)
    assert {one.name: one.value for one in view.statistics}["displacement x, median"] is None


def test_a_report_of_a_camera_alone_wants_no_calibration() -> None:
    states = tuple(LoadState(label) for label in ("00", "01"))
    campaign = Campaign("coupon", Specimen("coupon"), "camera", states, ("C1",))
    needs = report.KIND.checked_needs(campaign, Subject("coupon"), report.ReportParameters())
    sources = [need.source for need in needs]
    assert sorted(sources) == ["correlate-images", "measurement", "measurement", "strain-images"]


def test_gauges_that_were_read_can_be_asked_for() -> None:
    one = np.ones(1)
    place = np.zeros((1, 3))
    gauges = GaugeReadings(
        "small", ("G1",), 1e-3 * one, 1e-5 * one.astype(np.float32), place, np.ones(1, np.int32)
    )
    view = planar_view(*records(), SAMPLER, gauges)
    (found,) = (s for s in view.statistics if s.name == "G1")
    assert found.value == pytest.approx(1000.0)
    assert found.sigma == pytest.approx(10.0)
    assert found.charted
    states = tuple(LoadState(label) for label in ("00", "01"))
    campaign = Campaign("coupon", Specimen("coupon"), "camera", states, ("C1",))
    asked = report.ReportParameters(also=("gauges",))
    needs = report.KIND.checked_needs(campaign, Subject("coupon"), asked)
    assert [str(need.subject) for need in needs if need.source == "gauges"] == ["coupon/01/C1"]
