"""Views of a surface: their deviations are those of what is shown, and points are followed where they are."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.formats.report.charts import axes, axes_block, charts, ticks
from sms_jobs.formats.report.following import Followed, places
from sms_jobs.formats.report.surface import deformed_view, principal_sigma
from sms_jobs.formats.report.view import Sampler, Statistic, View
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.fields import MergedField, StrainField
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.quantity import SYMMETRIC

SIZE = (50, 70)
DRAWS = 20_000


def merged(displacement: np.ndarray, covariance: np.ndarray) -> MergedField:
    shape = (3, *SIZE)
    packed = [covariance["XYZ".index(a), "XYZ".index(b)] for a, b in SYMMETRIC]
    return MergedField(
        "C1",
        ("C1P1",),
        "mm",
        np.nan,
        np.broadcast_to(displacement[:, None, None], shape).copy(),
        np.zeros(shape),
        np.broadcast_to(np.array(packed, np.float32)[:, None, None], (6, *SIZE)).copy(),
        np.ones(SIZE, np.uint8),
        np.zeros(SIZE, np.uint32),
    )


def strain(values: np.ndarray | None = None) -> StrainField:
    xx = np.zeros(SIZE) if values is None else values
    components = np.stack([xx, 0 * xx, 0 * xx])
    sigma = np.full((3, *SIZE), 1e-5, np.float32)
    return StrainField("small", "mm", 20.0, components, sigma, components[:2], xx, np.zeros(SIZE, np.uint32))


def view(field: MergedField, of: StrainField | None = None, gauges: GaugeReadings | None = None) -> View:
    return deformed_view(field, "C1P1", of or strain(), Sampler(SIZE, 35, 0), gauges)


def test_the_deviation_of_a_length_is_that_along_it(rng: np.random.Generator) -> None:
    mean = np.array([0.3, -0.1, 0.8])
    root = rng.normal(0.0, 0.01, (3, 3))
    covariance = root @ root.T
    lengths = np.linalg.norm(rng.multivariate_normal(mean, covariance, DRAWS), axis=1)
    found = view(merged(mean, covariance)).fields[0]
    assert found.name == "displacement"
    assert found.sigma is not None
    # A deviation of 20,000 draws is known to 0.5 %; four times that.
    assert found.sigma[0, 0] == pytest.approx(lengths.std(), rel=0.02)


def test_the_deviation_of_a_length_that_is_lost_in_noise_is_not_too_small(rng: np.random.Generator) -> None:
    covariance = np.diag([1e-4, 1e-4, 4e-4])
    lengths = np.linalg.norm(rng.multivariate_normal(np.zeros(3), covariance, DRAWS), axis=1)
    found = view(merged(np.array([1e-6, 0.0, 0.0]), covariance)).fields[0]
    assert found.sigma is not None
    assert found.sigma[0, 0] >= lengths.std()


def test_the_deviations_of_principal_strains_are_their_scatter(rng: np.random.Generator) -> None:
    true, sigma = np.array([900.0, -300.0, 400.0]), np.array([20.0, 30.0, 15.0])
    drawn = true[:, None, None] + sigma[:, None, None] * rng.standard_normal((3, DRAWS, 1))
    radius = np.hypot(0.5 * (drawn[0] - drawn[1]), drawn[2])
    middle = 0.5 * (drawn[0] + drawn[1])
    predicted = principal_sigma(true[:, None, None], sigma[:, None, None])
    for found, values in zip(predicted, (middle + radius, middle - radius), strict=True):
        # First order, with errors of 5 % of the radius: 0.25 %; and 0.5 % of the scatter, four times.
        assert found.item() == pytest.approx(values.std(), rel=0.025)


def test_a_point_is_followed_at_one_pixel_over_the_states(rng: np.random.Generator) -> None:
    still = merged(np.array([0.1, 0.0, 0.0]), 1e-6 * np.eye(3))
    pattern = rng.random(SIZE)
    last = view(still, strain(1e-3 * pattern))
    (place,) = [p for p in places(last) if "strain" in p.name]
    assert place.row_px == 2 * place.row + 1
    # The 99th percentile of the samples themselves.
    sampled = 1e3 * pattern[1::2, 1::2]
    assert 1e3 * pattern[place.row_px, place.column_px] == pytest.approx(
        np.percentile(sampled, 99.0), abs=np.ptp(np.sort(sampled.ravel())[-20:])
    )
    followed = Followed((place,))
    for state, factor in (("S01", 0.5), ("S02", 1.0)):
        followed.add(state, view(still, strain(factor * 1e-3 * pattern)))
    (chart,) = followed.charts()
    half, whole = chart.lines[0].points
    # Single precision of either.
    assert half.value == pytest.approx(0.5 * whole.value, rel=2.0**-22)
    # 10 microstrain of both components of the circle, at most.
    assert whole.sigma == pytest.approx(10.0, rel=1e-3)


def test_gauges_are_charted_with_their_deviations() -> None:
    strains, sigmas = np.array([1e-3, np.nan]), np.array([2e-6, np.nan], np.float32)
    pixels = np.array([400, 3], np.int32)
    readings = GaugeReadings("small", ("G1", "G2"), strains, sigmas, np.zeros((2, 3)), pixels)
    followed = Followed(())
    followed.add("S01", view(merged(np.zeros(3), np.eye(3)), gauges=readings))
    (chart,) = followed.charts()  # what G2 could not read is not drawn
    assert (chart.title, chart.unit) == ("G1", "µε")
    assert chart.lines[0].points[0].sigma == pytest.approx(2.0, rel=1e-6)
    tables = " ".join(part.html for part in followed.tables())
    assert "1000 ± 2" in tables
    assert "G2 [µε]" in tables


def test_the_calibrations_part_stands_beside_sigma_or_is_said_not_to_be_known() -> None:
    field, strained = merged(np.array([0.1, 0.0, 0.0]), 1e-4 * np.eye(3)), strain()
    without = view(field, strained)
    assert not [one for one in without.statistics if "calibration" in one.name]
    assert any("not known; it is not zero" in note for note in without.notes)

    part = np.ones((3, *SIZE), np.float32) * np.array([3.0, 4.0, 0.0], np.float32)[:, None, None]
    gauges = GaugeReadings(
        "small",
        ("G1",),
        np.array([1e-3]),
        np.array([2e-6], np.float32),
        np.zeros((1, 3)),
        np.array([400], np.int32),
        sigma_calibration=np.array([7e-6], np.float32),
    )
    known = view(
        replace(field, sigma_calibration=1e-3 * part),
        replace(strained, sigma_calibration=1e-6 * part),
        gauges,
    )
    found = {one.name: one.value for one in known.statistics if "calibration" in one.name}
    assert found == {
        "sigma from the calibration, median": pytest.approx(5e-3),
        "sigma xx from the calibration, median": pytest.approx(3.0),
        "G1, sigma from the calibration": pytest.approx(7.0),
    }
    assert any("common to all pixels" in note for note in known.notes)


def test_what_bends_within_the_gauge_is_told_where_it_has_been_looked_for() -> None:
    field, strained = merged(np.array([0.1, 0.0, 0.0]), 1e-4 * np.eye(3)), strain()
    assert not [one for one in view(field, strained).statistics if "bends" in one.name]
    bias = np.full((3, *SIZE), 4e-6, np.float32)
    told = [one for one in view(field, replace(strained, bias=bias)).statistics if "bends" in one.name]
    assert [one.value for one in told] == [pytest.approx(4.0)]


def test_numbers_of_one_group_stand_in_one_table() -> None:
    followed = Followed(())
    for key in ("C1", "C2"):
        statistics = (Statistic("a", "mm", 1.0), Statistic("b", "", 2.0, group="<B>"))
        followed.add("S01", View(key, key, SIZE, 1, (), statistics))
    first, heading, second = followed.tables()
    assert heading.html == "<h3>&lt;B&gt;</h3>"
    assert first.html.count("<tr>") == second.html.count("<tr>") == 3


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3e-7, 8e-7), (12_345.0, 12_399.0), (-1.0, 1e6)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    found = ticks(low, high)
    assert 2 <= len(found) <= 7
    assert low - 1e-9 * (high - low) <= found[0] <= found[-1] <= high + 1e-9 * (high - low)
    steps = np.diff(found)
    # Equal but for rounding, and 1, 2 or 5 times a power of ten.
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert round(steps[0] / 10.0 ** np.floor(np.log10(steps[0] * (1 + 1e-9))), 6) in (1.0, 2.0, 5.0)


def test_campaigns_are_charted_along_what_varies() -> None:
    states = [
        LoadState(f"S{i:02}", load_n=100.0 * i, displacement_mm=0.0, channels={"<t> [C]": 20.0 + i})
        for i in range(3)
    ]
    states.append(LoadState("S03", channels={"read once": 1.0}))
    along = axes(states)
    assert [axis.label for axis in along] == ["load [N]", "<t> [C]", "state"]
    assert "S03" not in along[0].places  # nothing was read
    assert "&lt;t&gt; [C]" in charts([], along).html
    json.loads(re.sub("<[^>]*>", "", axes_block(along).html))


def test_the_median_of_a_lengths_deviation_is_called_so_and_not_as_that_of_the_vector() -> None:
    # Along X the deviation is 1 um; that of the vector, as `median_sigma_mm` states it, is above 3 um.
    covariance = np.diag([1e-6, 9e-6, 0.0])
    told = {one.name: one.value for one in view(merged(np.array([0.1, 0.0, 0.0]), covariance)).statistics}
    assert told["sigma of the length, median"] == pytest.approx(1e-3)
    assert "sigma, median" not in told
