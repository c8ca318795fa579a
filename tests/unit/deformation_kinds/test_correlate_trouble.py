"""What can go wrong with a specimen ends with reasons, numbers and a sentence, and without an exception."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.point_matches import summary
from sms_jobs.metrology.deformation.cracks.splitting import Split
from sms_jobs.metrology.deformation.matching import correlation
from sms_jobs.records.reasons import Reason

VIEW = "C1P1"
CHOSEN = CorrelateParameters(spacing_px=4, search_range_x_px=70)


def correlated(plate: Any, state: str) -> tuple[Any, Any, Any, dict[str, float]]:
    output = plate.run(correlate.KIND, plate.subject(state, VIEW), CHOSEN)
    field, matches = output.records["displacement"], output.records["matches"]
    for values in (matches.u, matches.v, matches.sigma_u, matches.sigma_v):
        np.testing.assert_array_equal(np.isfinite(values), matches.reason == Reason.VALID)
    np.testing.assert_array_equal(np.isfinite(field.displacement).all(axis=0), field.reason == Reason.VALID)
    assert all(np.isfinite(value) for value in output.statistics.values())
    fractions = [v for name, v in output.statistics.items() if name.endswith("fraction_of_points")]
    assert sum(fractions) + output.statistics["matched_fraction"] == 1.0
    return field, matches, output.records["regions"], output.statistics


def test_a_plate_that_broke_is_two_regions_from_then_on(troubled_plate: Any) -> None:
    field, matches, regions, statistics = correlated(troubled_plate, "S01")
    assert statistics["regions_split"] == 1.0
    assert len(regions.regions) == 2
    assert [region.area for region in regions.regions] == [(regions.labels == k).sum() for k in (1, 2)]
    good = matches.reason == Reason.VALID
    assert good.mean() > 0.9
    # 8 mm are 5.7 px across, half of it each way; between two modes that far apart nothing lies.
    u = matches.u[good]
    assert u.max() - u.min() > 5.0
    assert (np.minimum(np.abs(u - u.min()), np.abs(u - u.max())) < 0.5).all()
    valid = field.reason == Reason.VALID
    step = np.abs(np.diff(field.displacement[0], axis=1))[valid[:, 1:] & valid[:, :-1]]
    # Within a piece displacement is smooth; pixels on both sides of the crack do not touch.
    assert step.max() < 1.0
    assert valid.sum() > 0.85 * np.count_nonzero(regions.labels)


def test_what_left_the_view_is_told_apart_from_what_was_not_found(troubled_plate: Any) -> None:
    _, matches, _, statistics = correlated(troubled_plate, "S02")
    # 85 of 150 mm; some of what is still seen is too near to the border.
    assert 0.2 < statistics["matched_fraction"] < 0.6
    assert statistics["left_image_fraction_of_points"] > 0.4
    assert statistics["no_match_fraction_of_points"] < 0.1
    left = matches.reason == Reason.LEFT_IMAGE
    good = matches.reason == Reason.VALID
    # Who goes right leaves on the right.
    assert np.median(matches.x[left]) > np.median(matches.x[good])


def test_a_plate_that_is_gone_is_not_found(troubled_plate: Any) -> None:
    field, matches, _, statistics = correlated(troubled_plate, "S03")
    assert (matches.reason != Reason.VALID).all()
    assert (field.reason != Reason.VALID).all()
    assert statistics["no_match_fraction_of_points"] > 0.9
    assert statistics["valid_fraction"] == 0.0


def test_a_plate_without_texture_says_so(troubled_plate: Any) -> None:
    spoilt = replace(troubled_plate, results=dict(troubled_plate.results))
    key = ("reconstruct", spoilt.subject("S00", VIEW))
    phase = spoilt.results[key]["phase"]
    blank = replace(phase, mean_intensity=np.full_like(phase.mean_intensity, 700.0))
    spoilt.results[key] = {**spoilt.results[key], "phase": blank}
    _, matches, _, statistics = correlated(spoilt, "S01")
    assert (matches.reason == Reason.NO_TEXTURE).mean() > 0.9
    assert statistics["no_texture_fraction_of_points"] > 0.9


def test_the_summary_is_a_sentence_about_every_point() -> None:
    ending = np.array([correlation.CONVERGED] * 5 + [correlation.LEFT_IMAGE] * 2 + [correlation.NO_TEXTURE])
    assert summary(ending, None) == "matched 5 of 8 points; 2 left the image, 1 without texture"
    split = Split(np.zeros((1, 1), np.int32), {2: (2, 4)})
    assert summary(ending[:5], split) == "matched 5 of 5 points; region 2 has come apart into 2"
    lost = np.full(3, correlation.NOT_CONVERGED)
    assert summary(lost, None) == (
        "matched 0 of 3 points; 3 without a counterpart; look at the texture of both states, and at the "
        "search range"
    )
