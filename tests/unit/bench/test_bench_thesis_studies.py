"""What the studies of the thesis's campaigns compute from fields is right on exact ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.bench.compared_fields import Mean, components, lengths, rms
from sms_jobs.bench.studies.buckling_panel import exact_regions, places
from sms_jobs.bench.studies.top_hat import Point, around, beside
from sms_jobs.bench.studies.wing_panel import exact_gauge, joined, netted, tip_of
from sms_jobs.bench.study import Study
from sms_jobs.errors import InvalidInput
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField, StrainField
from sms_jobs.records.scene import Simulation, StiffenedPanel, StringerCrack
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.campaigns import top_hat_before_two_cameras
from sms_jobs.virtual_rig.truth import Truth, exact_truth
from sms_jobs.virtual_rig.wing_campaigns import GAUGES_MM, TABLE_5, buckling_panel, cracked_wing_panel

HAT = top_hat_before_two_cameras("hat", "small", (5.0,))[1]
BUCKLING = buckling_panel("buckling", "small")[1]
WING = [campaign for _, campaign in cracked_wing_panel("wing", "small")]


def truth_of(campaign: Campaign, label: str, view: str) -> Truth:
    assert campaign.scene is not None
    rest, end = (
        Simulation.of(campaign.scene, view_of(view), s.deformation, s.label)
        for s in (campaign.reference, campaign.state(label))
    )
    return exact_truth(rest, end, view_of(view).partners, threads=2)


def exact_field(truth: Truth, off_mm: float = 0.0) -> DisplacementField:
    """Return the truth as if it had been measured, off along X, with a deviation of 0.02 mm each way."""
    reason = np.where(truth.shape.lit & truth.lit_and_seen_at_end, 0, 1).astype(np.uint32)
    covariance = np.zeros((6, *reason.shape), np.float32)
    covariance[[0, 3, 5]] = 0.02**2
    displacement = truth.displacement + np.array([off_mm, 0.0, 0.0])[:, None, None]
    image = np.zeros((2, *reason.shape))
    return DisplacementField(
        "C1P1", "S00", "mm", displacement, covariance, image, reason, subset_radius_px=10
    )


@pytest.fixture(scope="module")
def hat() -> Truth:
    return truth_of(HAT, "S01", "C1P1")


def test_lengths_and_components_are_those_of_the_field(hat: Truth) -> None:
    field = exact_field(hat)
    moved = lengths(field, hat)
    known = np.isfinite(moved.measured)
    assert (known == (field.reason == 0)).all()
    np.testing.assert_allclose(moved.error[known], 0.0, atol=1e-12)
    np.testing.assert_allclose(moved.sigma[known], 0.02, rtol=1e-6)  # of float32
    off = components(exact_field(hat, 0.01), hat, np.array([0.6, 0.0, 0.8]))
    mean = off.mean(np.ones_like(known))
    assert mean.error == pytest.approx(0.006)
    assert mean.sigma == pytest.approx(0.02 / np.sqrt(known.sum() / 21**2), rel=1e-5)
    assert mean.z == pytest.approx(0.006 / mean.sigma)
    assert np.isnan(off.mean(np.zeros_like(known)).measured)
    assert rms(np.array([3.0, 4.0, np.nan])) == pytest.approx(np.sqrt(12.5))


def test_the_loaded_point_is_that_of_both_views_by_their_variances() -> None:
    both = Point(Mean(1.0, 1.1, 0.1), Mean(2.0, 1.1, 0.2)).both
    # Weights of 4 and 1.
    assert (both.measured, both.exact, both.sigma) == pytest.approx((1.2, 1.1, 0.1 / np.sqrt(1.25)))


def test_two_cameras_beside_fringes_differ_where_they_do(hat: Truth) -> None:
    loaded = around(hat, 10.0)
    assert 100 < loaded.sum() < around(hat, 100.0).sum()
    right = lengths(exact_field(hat), hat)
    longer = replace(right, measured=right.measured + np.where(around(hat, 100.0), 0.1, 0.3))
    found = beside(right, longer, hat)
    assert (found.good, found.stereo, found.fringes) == pytest.approx((0.1, 0.1, 0.0), abs=1e-9)
    assert 0.1 < found.everywhere < 0.3
    # The top is lit and in sight all over but for its rim.
    assert found.found > 0.95


def test_gauges_and_the_tip_are_those_of_the_exact_fields() -> None:
    state = WING[0].states[4]
    crack = state.deformation[0]
    assert isinstance(crack, StringerCrack)
    for place, strain in zip(GAUGES_MM, TABLE_5[3][1:], strict=True):
        # Green-Lagrange adds half the square, 1.4e-6, and the gauge's far end sees 4e-4 of the crack's part.
        assert exact_gauge(state.deformation, *place) == pytest.approx(strain, abs=2.5e-6)
    nets = []
    for campaign in WING:
        truth = truth_of(campaign, state.label, "C1P1")
        field = exact_field(truth)
        strained = StrainField(
            "green-lagrange", "mm", 20.0, truth.strain("green-lagrange"),
            np.full_like(truth.displacement, 1e-5, dtype=np.float32), truth.displacement[:2],
            truth.displacement[0], field.reason,
        )  # fmt: skip
        assert campaign.scene is not None
        net = netted(truth, campaign.scene.placement.matrix(), field, strained)
        known = np.isfinite(net.strain)
        np.testing.assert_allclose(net.strain[known], net.exact[known], atol=1e-12)
        nets.append(net)
    both = np.isfinite(nets[0].displacement) & np.isfinite(nets[1].displacement)
    assert both[0].sum() > 200
    # Cells hold other pixels in every view: their means are at most half a cell, 3 mm, of the strain apart.
    apart = np.abs(nets[0].displacement - nets[1].displacement)[:2, both[0]]
    assert apart.max() < 3.0 * 2.5e-3
    whole = joined([net.strain for net in nets])
    tip, _ = tip_of(whole, np.full_like(whole, 1e-5))
    # The step is that of the strain; the bulge adds half the square of its slope, (0.4 / 100)^2 / 2 = 8e-6
    # of 5e-4.
    assert tip == pytest.approx(crack.tip_mm, abs=4.0)
    assert np.isnan(tip_of(np.full_like(whole, np.nan), whole)).all()


def test_the_buckling_panels_places_and_pieces() -> None:
    truth = truth_of(BUCKLING, "S07", "C1P1")
    assert BUCKLING.scene is not None
    panel = BUCKLING.scene.surface
    assert isinstance(panel, StiffenedPanel)
    found = places(truth, panel)
    out = components(exact_field(truth), truth, BUCKLING.scene.placement.matrix()[:, 2])
    upper, lower, skin = (out.mean(where).exact for where in found.values())
    # 3 mm x (1 +- 0.008 x 32.5) x 0.963 in the mean over 20 mm each way; foot and skin bend alike by 1 mm.
    assert upper - skin == pytest.approx(3.0 * 0.963 * (1.0 + 0.008 * 32.5), abs=0.05)
    assert lower - skin == pytest.approx(3.0 * 0.963 * (1.0 - 0.008 * 32.5), abs=0.05)
    # Skin and web in two pieces and more, each half of the foot in two, the rod, and what stands on them.
    assert exact_regions(truth, 200) >= 12


def test_a_study_of_one_size_has_no_other() -> None:
    one = Study("one", "one size", lambda say: None)  # type: ignore[arg-type, return-value]
    two = replace(one, full=lambda say: None)  # type: ignore[arg-type, return-value]
    assert one.of_size(None) is one.run
    assert (two.of_size("small"), two.of_size("full")) == (two.run, two.full)
    with pytest.raises(InvalidInput, match="has one size; leave --size out"):
        one.of_size("full")
