"""A dent of known depth is found where it is, as deep as it is, with the uncertainty that it has."""

from __future__ import annotations

import numpy as np
import pytest
from support.bent_plate import CHORD_ERROR_MM, PLACEMENT, measured, plate_surface, seen_plate

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.transforms import inverse
from sms_jobs.metrology.surfaces.deviation import (
    PERCENTILES,
    Verdict,
    deviations,
    statistics_of,
    verdicts,
)
from sms_jobs.metrology.surfaces.registration import register
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface, triangle_surface

TRUTH = inverse(PLACEMENT)
SIGMA_MM = 0.05
DEPTH_MM, RADIUS_MM, AT = 1.5, 25.0, (60.0, 40.0)


@pytest.fixture(scope="module")
def plate() -> TriangleSurface:
    return triangle_surface(*plate_surface())


def test_the_deviation_of_exact_points_is_the_chord_error(
    plate: TriangleSurface, rng: np.random.Generator
) -> None:
    found = deviations(plate, measured(seen_plate(), seen_plate().xyz, 1e-9, rng), TRUTH, np.zeros((6, 6)))
    known = np.isfinite(found.deviation)
    assert known.mean() > 0.95
    # Chords of a hill are below it, of a valley above it.
    assert np.abs(found.deviation[known]).max() < 1.1 * CHORD_ERROR_MM


def test_a_dent_is_as_deep_as_it_is(plate: TriangleSurface, rng: np.random.Generator) -> None:
    points = measured(seen_plate(), seen_plate().dented(DEPTH_MM, RADIUS_MM, AT), SIGMA_MM, rng)
    registration = register(plate, points, TRUTH)
    found = deviations(plate, points, registration.pose, registration.covariance)
    known = np.isfinite(seen_plate().xyz).all(axis=0)
    place = seen_plate().place[:2, known]
    square = (place[0] - AT[0]) ** 2 + (place[1] - AT[1]) ** 2
    expected = -DEPTH_MM * np.exp(-0.5 * square / RADIUS_MM**2)
    error = found.deviation - expected
    compared = np.isfinite(error)
    # Noise along the normal, 5 sigma for a thousand points; the chords; 0.014 mm by which a dent may pull the
    # part (test_registration); and the distance to a bent surface, which differs from the length along the
    # normal by nothing: the closest point of a point on a normal is the foot of that normal.
    assert np.abs(error[compared]).max() < 5.0 * SIGMA_MM + CHORD_ERROR_MM + 0.014
    bottom = compared & (square < 8.0**2)
    count = np.count_nonzero(bottom)
    assert count > 1
    assert abs(np.mean(error[bottom])) < 3.0 * SIGMA_MM / np.sqrt(count) + CHORD_ERROR_MM + 0.014


def test_sigma_is_what_the_deviation_scatters_by(plate: TriangleSurface) -> None:
    runs = []
    for seed in range(12):
        points = measured(seen_plate(), seen_plate().xyz, SIGMA_MM, np.random.default_rng(seed))
        registration = register(plate, points, TRUTH)
        found = deviations(plate, points, registration.pose, registration.covariance)
        runs.append(found.deviation / found.sigma)
    pulls = np.array(runs)
    inner = np.isfinite(pulls).all(axis=0)
    # Against the mean over runs, which takes the chords out: 11 of 12 degrees of freedom remain.
    spread = np.sqrt(np.mean(np.var(pulls[:, inner], axis=0, ddof=1)))
    # Some 3000 points in 12 runs: 1 / sqrt(2 * 33,000) = 0.4 %. Registration takes a little noise away where
    # sigma adds some: 6 of 3000 points' worth, both ways.
    assert abs(spread - 1.0) < 0.03


def test_what_the_registration_does_not_know_counts(plate: TriangleSurface, rng: np.random.Generator) -> None:
    points = measured(seen_plate(), seen_plate().xyz, SIGMA_MM, rng)
    covariance = np.zeros((6, 6))
    covariance[5, 5] = 0.3**2
    sure, unsure = (deviations(plate, points, TRUTH, c) for c in (np.zeros((6, 6)), covariance))
    known = np.isfinite(sure.sigma)
    added = np.sqrt(unsure.sigma[known] ** 2 - sure.sigma[known] ** 2)
    # The shift along z, times the cosine of the slope: at most atan(60 * 1.5 * 4 / 420) = 40 degrees.
    assert np.all((added > 0.3 * 0.7) & (added <= 0.3 * (1.0 + 1e-9)))


def test_points_with_no_counterpart_have_no_deviation(
    plate: TriangleSurface, rng: np.random.Generator
) -> None:
    points = measured(seen_plate(), seen_plate().dented(4.0, 20.0, AT), SIGMA_MM, rng)
    found = deviations(plate, points, TRUTH, np.zeros((6, 6)), within_mm=2.0)
    known = np.isfinite(found.deviation)
    assert np.abs(found.deviation[known]).max() < 2.0
    assert 0.0 < np.mean(~known) < 0.1
    np.testing.assert_array_equal(np.isfinite(found.sigma), known)


def test_verdicts_ask_for_the_whole_interval() -> None:
    deviation = np.array([0.0, 0.07, 0.09, 0.1, 0.11, 0.13, -0.25, np.nan])
    sigma = np.full(8, 0.01)
    found = verdicts(deviation, sigma, -0.2, 0.1, 2.0)
    w, u, o = Verdict.WITHIN, Verdict.UNDECIDED, Verdict.OUTSIDE
    assert found.tolist() == [w, w, u, u, u, o, o, Verdict.NOT_MEASURED]
    plain = verdicts(deviation, sigma, -0.2, 0.1, 0.0)
    assert plain.tolist() == [w, w, w, w, o, o, o, Verdict.NOT_MEASURED]
    with pytest.raises(InvalidInput, match="must be below the upper"):
        verdicts(deviation, sigma, 0.1, 0.1)
    with pytest.raises(InvalidInput, match="0 or more"):
        verdicts(deviation, sigma, 0.0, 0.1, -1.0)


def test_statistics_are_those_of_the_points_that_were_compared(rng: np.random.Generator) -> None:
    deviation, sigma = rng.normal(0.01, 0.05, (20, 30)), np.full((20, 30), 0.02, np.float32)
    deviation[:3] = np.nan
    verdict = verdicts(deviation, sigma, -0.1, 0.1, 1.0)
    found = statistics_of(deviation, sigma, verdict)
    values = deviation[3:].reshape(-1)
    assert found.points == values.size
    np.testing.assert_allclose(found.rms**2, found.mean**2 + found.standard_deviation**2, rtol=1e-12)
    assert (found.minimum, found.maximum) == (values.min(), values.max())
    np.testing.assert_allclose(found.percentiles, np.percentile(values, PERCENTILES))
    assert found.within + found.undecided + found.outside == pytest.approx(1.0)
    nothing = statistics_of(np.full(3, np.nan), np.ones(3), np.zeros(3, np.uint8))
    assert nothing.points == 0
    assert np.isnan(nothing.mean)
