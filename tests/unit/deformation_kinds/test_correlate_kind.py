"""Correlating a simulated view of states finds the true displacement, with the errors that it states."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.records.fields import DisplacementField, ImageMatches, Regions, Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.virtual_rig.truth import exact_truth

VIEW = "C1P1"


def errors(plate: Any, field: DisplacementField) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the length of the error, its standard deviation, and where displacement can be had."""
    truth = plate.truth(VIEW)
    length = np.linalg.norm(field.displacement - truth.displacement, axis=0)
    sigma = np.sqrt(field.covariance[[0, 3, 5]].sum(axis=0))
    return length, sigma, truth.shape.seen & truth.shape.lit & truth.lit_and_seen_at_end


def test_displacement_is_the_true_one(plate: Any) -> None:
    records = plate.results["correlate", plate.subject("S01", VIEW)]
    field = records["displacement"]
    length, sigma, expected = errors(plate, field)
    valid = (field.reason == Reason.VALID) & expected
    assert valid.sum() > 0.9 * expected.sum()
    # A hundredth of a pixel, which is 1.4 mm here; the required 1/25,000 of the diagonal is for 512 px.
    assert np.sqrt(np.mean(length[valid] ** 2)) < 0.014
    # The required 20 %, and what is left of a plate's few thousand pixels whose errors go together: 10 %.
    assert 0.7 < np.sqrt(np.mean((length[valid] / sigma[valid]) ** 2)) < 1.3
    assert field.reference_state == "S00"


def test_every_value_is_known_or_has_a_reason(plate: Any) -> None:
    records = plate.results["correlate", plate.subject("S01", VIEW)]
    assert list(records) == ["displacement", "matches", "regions"]
    field, matches, regions = records["displacement"], records["matches"], records["regions"]
    assert isinstance(matches, ImageMatches)
    assert isinstance(regions, Regions)
    for values in (field.displacement, field.covariance, field.image_displacement):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=0), field.reason == Reason.VALID)
    for values in (matches.u, matches.v, matches.sigma_u, matches.sigma_v, *matches.gradient):
        np.testing.assert_array_equal(np.isfinite(values), matches.reason == Reason.VALID)
    assert field.displacement.dtype == np.float64
    assert field.covariance.dtype == np.float32
    assert field.reason.dtype == np.uint32
    assert len(regions.regions) == regions.labels.max()
    assert regions.regions[0].area == np.count_nonzero(regions.labels == 1)


@pytest.mark.parametrize("texture", ["white", "fringe-average"])
def test_either_texture_will_do(plate: Any, texture: Any) -> None:
    parameters = CorrelateParameters(texture=texture, spacing_px=6)
    output = plate.run(correlate.KIND, plate.subject("S01", VIEW), parameters)
    length, _, expected = errors(plate, output.records["displacement"])
    valid = (output.records["displacement"].reason == Reason.VALID) & expected
    assert valid.sum() > 0.9 * expected.sum()
    assert np.sqrt(np.mean(length[valid] ** 2)) < plate.calibration.volume.diagonal_mm / 10_000


@pytest.mark.parametrize(
    "chosen", [{"shape_order": 0}, {"shape_order": 2, "subset_radius_px": 14}, {"interpolation": "cubic"}]
)
def test_any_shape_order_and_spline_will_do(plate: Any, chosen: dict[str, Any]) -> None:
    parameters = CorrelateParameters(spacing_px=6, **chosen)
    output = plate.run(correlate.KIND, plate.subject("S01", VIEW), parameters)
    length, sigma, expected = errors(plate, output.records["displacement"])
    valid = (output.records["displacement"].reason == Reason.VALID) & expected
    assert valid.sum() > 0.9 * expected.sum()
    assert np.sqrt(np.mean(length[valid] ** 2)) < plate.calibration.volume.diagonal_mm / 10_000
    # As for the first order; a shift alone disagrees with a plate that bends, and says less than that.
    if chosen.get("shape_order") != 0:
        assert 0.7 < np.sqrt(np.mean((length[valid] / sigma[valid]) ** 2)) < 1.3


def test_the_peak_of_the_correlation_will_do_for_a_comparison(plate: Any) -> None:
    """A tenth of a pixel is 0.14 mm here; the pull towards whole pixels is in what is stated."""
    parameters = CorrelateParameters(spacing_px=6, method="fourier-newton", maximum_sigma_px=0.3)
    output = plate.run(correlate.KIND, plate.subject("S01", VIEW), parameters)
    length, sigma, expected = errors(plate, output.records["displacement"])
    valid = (output.records["displacement"].reason == Reason.VALID) & expected
    assert valid.sum() > 0.9 * expected.sum()
    assert 0.014 < np.sqrt(np.mean(length[valid] ** 2)) < 0.3
    # The pull is the same for neighbours and does not scatter: it is told to within a factor of two.
    assert 0.5 < np.sqrt(np.mean((length[valid] / sigma[valid]) ** 2)) < 2.0


def test_without_regions_one_piece_is_matched_as_with_them(plate: Any) -> None:
    parameters = CorrelateParameters(spacing_px=6, regions="none")
    output = plate.run(correlate.KIND, plate.subject("S01", VIEW), parameters)
    field, matches = output.records["displacement"], output.records["matches"]
    length, _, expected = errors(plate, field)
    # What lies beside the plate is matched too, and spoils subsets that see it, a radius into the plate.
    assert matches.region.min() == 0
    inner = ndimage.binary_erosion(expected, iterations=12)
    assert (field.reason[inner] == Reason.VALID).mean() > 0.95
    good = inner & (field.reason == Reason.VALID)
    assert np.sqrt(np.mean(length[good] ** 2)) < plate.calibration.volume.diagonal_mm / 10_000


def test_the_chosen_test_of_discontinuities_parts_regions(plate: Any) -> None:
    """A pixel sees 1.4 mm: neighbours are farther apart than half of that, and nearer than twice."""
    parts = {}
    for distance in (0.7, 2.8):
        parameters = CorrelateParameters(
            spacing_px=6, discontinuity="distance", neighbour_distance_mm=distance
        )
        records = plate.run(correlate.KIND, plate.subject("S01", VIEW), parameters).records
        valid = records["displacement"].reason == Reason.VALID
        parts[distance] = len(records["regions"].regions), int(valid.sum())
    assert parts[0.7] == (0, 0)
    usual = plate.run(correlate.KIND, plate.subject("S01", VIEW), CorrelateParameters(spacing_px=6)).records
    assert parts[2.8][0] == len(usual["regions"].regions) == 1
    assert parts[2.8][1] > 0.9 * np.count_nonzero(usual["displacement"].reason == Reason.VALID)


@pytest.mark.parametrize("reference", ["auto", "previous"])
def test_a_plate_that_turns_is_followed(turning_plate: Any, reference: Any) -> None:
    """Turned by 18 degrees, no subset is found by looking for shifts; by 9 all are."""
    found = replace(turning_plate, results=dict(turning_plate.results))
    chosen = CorrelateParameters(reference=reference, spacing_px=6)
    first, second = (found.subject(label, VIEW) for label in ("S01", "S02"))
    roles = {need.role for need in correlate.KIND.checked_needs(found.campaign, second, chosen)}
    assert {"previous", "previous_measurement", "previous_shape"} < roles
    assert len(correlate.KIND.checked_needs(found.campaign, first, chosen)) == len(roles) - 3
    found.keep(correlate.KIND, first, chosen)
    output = found.run(correlate.KIND, second, chosen)
    field, matches = output.records["displacement"], output.records["matches"]
    simulations = (
        found.results["measurement", found.subject(s, VIEW)]["measurement"] for s in ("S00", "S02")
    )
    truth = exact_truth(*(m.simulation for m in simulations))
    expected = truth.shape.seen & truth.shape.lit & truth.lit_and_seen_at_end
    valid = (field.reason == Reason.VALID) & expected
    assert valid.sum() > 0.85 * expected.sum()
    length = np.linalg.norm(field.displacement - truth.displacement, axis=0)[valid]
    # A fiftieth of a pixel, which is 1.4 mm here; the plate's ends go 23 mm.
    assert np.sqrt(np.mean(length**2)) < 0.03
    matched = matches.reason == Reason.VALID
    assert (matches.steps[~matched] == 0).all()
    assert (matches.steps[matched] == (1 if reference == "auto" else 2)).mean() > 0.9
    alone = found.run(correlate.KIND, second, CorrelateParameters(spacing_px=6)).records["matches"]
    assert (alone.reason == Reason.VALID).mean() < 0.2
    assert alone.steps is None
    looking = CorrelateParameters(spacing_px=6, search_range_rotation_rad=0.4)
    turned = found.run(correlate.KIND, second, looking).records["matches"]
    assert (turned.reason == Reason.VALID).mean() > 0.85


def test_only_the_region_of_interest_is_matched(plate: Any) -> None:
    subject = plate.subject("S01", VIEW)
    chosen = CorrelateParameters(
        spacing_px=6, region_of_interest="rectangle 30 40 90 80 - rectangle 50 50 60 60"
    )
    output = plate.run(correlate.KIND, subject, chosen)
    field, matches = output.records["displacement"], output.records["matches"]
    inside = np.zeros(field.reason.shape, dtype=bool)
    inside[40:81, 30:91] = True
    inside[50:61, 50:61] = False
    assert inside[matches.y.astype(int), matches.x.astype(int)].all()
    assert (field.reason[~inside] != Reason.VALID).all()
    length, sigma, expected = errors(plate, field)
    inner = ndimage.binary_erosion(inside, iterations=2) & expected
    assert (field.reason[inner] == Reason.VALID).mean() > 0.95
    good = inner & (field.reason == Reason.VALID)
    # Subsets end at its edge, as they do at a region's: noisier there, and said so.
    assert 0.7 < np.sqrt(np.mean((length[good] / sigma[good]) ** 2)) < 1.3
    # What nobody wanted is no loss.
    assert output.statistics["valid_fraction"] > 0.85
    assert output.statistics["valid_fraction_of_image"] == pytest.approx(np.mean(field.reason == 0))
    elsewhere = CorrelateParameters(region_of_interest="rectangle 0 0 3 3")
    output = plate.run(correlate.KIND, subject, elsewhere)
    assert len(output.records["matches"].x) == 0
    assert output.statistics["valid_fraction"] == 0.0


def test_more_points_near_edges(plate: Any) -> None:
    subject = plate.subject("S01", VIEW)
    regular, refined = (
        plate.run(correlate.KIND, subject, CorrelateParameters(spacing_px=8, edge_spacing_px=fine)).records
        for fine in (None, 2)
    )
    assert len(refined["matches"].x) > 1.3 * len(regular["matches"].x)
    length, _, expected = errors(plate, refined["displacement"])
    valid = (refined["displacement"].reason == Reason.VALID) & expected
    assert valid.sum() > 0.9 * expected.sum()
    assert np.sqrt(np.mean(length[valid] ** 2)) < 0.014


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"region_of_interest": "circle 1 2 3"}, "is incomplete|no number"),
        ({"region_of_interest": ["rectangle 1", "2", "3"]}, "LEFT TOP RIGHT BOTTOM"),
        ({"spacing_px": 8, "edge_spacing_px": 3}, "must divide spacing_px = 8"),
        ({"spacing_px": 16, "edge_spacing_px": 2}, "at least a quarter"),
        ({"neighbour_distance_mm": 2.0}, "2 means nothing with discontinuity = gap"),
        (
            {"neighbour_distance_mm": 2.0, "discontinuity": "gradient"},
            "nothing with discontinuity = gradient",
        ),
        ({"slope_half_width_px": 3, "discontinuity": "distance"}, "slope_half_width_px = 3 means nothing"),
        (
            {"neighbour_distance_mm": 2.0, "discontinuity": "distance", "maximum_slope_rad": 1.2},
            "maximum_slope_rad = 1.2 means nothing beside neighbour_distance_mm = 2",
        ),
        ({"regions": "none", "discontinuity": "gradient"}, "mean nothing with regions = none"),
        ({"slope_half_width_px": 1}, "greater than or equal to 2"),
        ({"maximum_slope_rad": 1.6}, "less than or equal to 1.55"),
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CorrelateParameters.model_validate(given)


def test_parameters_can_be_given_as_words() -> None:
    assert CorrelateParameters.model_validate({"shape_order": "2", "interpolation": "cubic"}).shape_order == 2
    for order in ("-1", "3"):
        with pytest.raises(ValueError, match="shape_order"):
            CorrelateParameters.model_validate({"shape_order": order})


def test_threads_do_not_matter(plate: Any) -> None:
    subject = plate.subject("S01", VIEW)
    one, two = (plate.run(correlate.KIND, subject, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(
        one.records["displacement"].displacement, two.records["displacement"].displacement
    )
    assert one.statistics == two.statistics


@pytest.mark.parametrize("spoilt", ["no shape before", "no shape after", "no texture"])
def test_poor_data_give_reasons_and_no_error(plate: Any, spoilt: str) -> None:
    subject = plate.subject("S01", VIEW)
    results = dict(plate.results)
    if spoilt == "no texture":
        key = ("reconstruct", subject)
        phase = results[key]["phase"]
        blank = replace(phase, mean_intensity=np.full_like(phase.mean_intensity, 700.0))
        results[key] = {**results[key], "phase": blank}
    else:
        key = ("reconstruct", subject if spoilt.endswith("after") else plate.subject("S00", VIEW))
        cloud: Surface = results[key]["surface"]
        lost = replace(
            cloud,
            position=np.full_like(cloud.position, np.nan),
            covariance=np.full_like(cloud.covariance, np.nan),
            reason=np.full_like(cloud.reason, Reason.LOW_MODULATION),
        )
        results[key] = {**results[key], "surface": lost}
    output = replace(plate, results=results).run(correlate.KIND, subject)
    field = output.records["displacement"]
    assert (field.reason != Reason.VALID).all()
    assert np.isnan(field.displacement).all()
    assert output.statistics["valid_fraction"] == 0.0
    assert all(np.isfinite(v) for v in output.statistics.values())
