"""Deviations of matches between cameras, by what they scatter across the images of their rays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.two_cameras import Floats, cameras, curved, seen_by

from sms_jobs.metrology.deformation.matching.correlation import CONVERGED, NOT_CONVERGED, Matches
from sms_jobs.metrology.deformation.matching.grid import GridMatches
from sms_jobs.metrology.deformation.matching.ray_scatter import scatter_of_places, stated_by_rays
from sms_jobs.metrology.geometry.camera import project

RADIUS, SPACING = 4, 3
STATED = 0.01
"""In px, of every match."""
Along = Callable[[Floats], Floats]


def matches(scatter: Along, trend: Along, misfit: float = 4.0) -> GridMatches:
    """Return matches that scatter by so many px and are off by a trend, both from 0 to 1 along the columns.

    Their errors are drawn one by one, though their subsets would overlap.
    """
    rig = cameras()
    points = np.moveaxis(seen_by(rig[0], curved).points, 0, -1)
    place = project(rig[1].intrinsics, rig[1].pose, points)
    rows, columns = points.shape[:2]
    y, x = (axis.ravel() for axis in np.mgrid[1:rows:SPACING, 1:columns:SPACING])
    slope = np.stack([np.gradient(place, axis=1), np.gradient(place, axis=0)], axis=-1)[y, x]
    random = np.random.default_rng(4)
    there = place[y, x] + random.normal(0.0, 1.0, (len(x), 2)) * scatter(x / columns)[:, None]
    there[:, 1] += trend(x / columns)
    warp = np.zeros((len(x), 6))
    warp[:, [0, 3]] = there - np.stack([x, y], axis=1)
    warp[:, [1, 2]], warp[:, [4, 5]] = slope[:, 0] - [1.0, 0.0], slope[:, 1] - [0.0, 1.0]
    count = len(x)
    found = Matches(
        warp,
        np.full((count, 2), STATED),
        np.full(count, 0.99),
        np.ones(count, np.int32),
        np.full(count, CONVERGED, np.int32),
        np.full(count, misfit),
    )
    return GridMatches(x, y, found)


def stated(found: GridMatches) -> tuple[Floats, Floats]:
    """Return where nodes lie along the columns, 0 to 1, and their deviations (n, 2) by their rays."""
    rig = cameras()
    result = stated_by_rays(*rig, found, RADIUS, SPACING)
    return found.x / rig[0].columns, result.matches.sigma


def in_partner(found: GridMatches) -> Floats:
    """Return STATED in px of the partner's image (n, 2), which shows what is one px there so many px wide."""
    warp = found.matches.warp
    slope = np.eye(2) + np.stack([warp[:, [1, 2]], warp[:, [4, 5]]], axis=1)
    return STATED * np.linalg.norm(slope, axis=2)


def test_deviations_are_those_of_the_scatter_here_and_there() -> None:
    def scatter(x: Floats) -> Floats:
        return np.where(x < 0.5, 0.02, 0.006)

    def trend(x: Floats) -> Floats:
        return 0.1 * np.sin(2.0 * np.pi * x)  # what a calibration may be wrong by

    x, sigma = stated(matches(scatter, trend))
    for part, expected in ((x < 0.4, 0.02), (x > 0.6, 0.006)):
        # 5,000 second differences of each axis tell their own mean to 2 %; the trend's are 0.006 px at most.
        assert np.sqrt(np.mean(sigma[part] ** 2)) == pytest.approx(expected, rel=0.05)
        # About one node 13 x 13 of either axis tell a variance to some 12 %.
        assert np.std(sigma[part]) < 0.1 * expected


def test_no_deviation_is_less_than_that_by_noise() -> None:
    """What a subset leaves over is four times noise: its deviation is at least half of what it said."""
    found = matches(lambda x: 0.001 + 0.0 * x, lambda x: 0.0 * x)
    _, sigma = stated(found)
    np.testing.assert_allclose(sigma, 0.5 * in_partner(found))


def test_what_is_of_another_surface_is_no_scatter() -> None:
    """One match in a hundred is off by 100 deviations, for which second differences count as 4."""
    found = matches(lambda x: 0.01 + 0.0 * x, lambda x: 0.0 * x)
    found.matches.warp[::101, 3] += 100 * STATED
    _, sigma = stated(found)
    # Three second differences of an axis hold each: 3 % of them, of 16 at most in place of 1.
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(STATED * np.sqrt(1.0 + 0.03 * 15.0), rel=0.05)


@pytest.mark.parametrize("times", [2.0, 10.0, 30.0])
def test_scatter_is_told_however_large_it_is(times: float) -> None:
    """None of its second differences counts for more than 4 deviations, and yet it is not cut off."""
    found = matches(lambda x: times * STATED + 0.0 * x, lambda x: 0.0 * x)
    _, sigma = stated(found)
    # Of 30 deviations a tenth of some 340 second differences about a node are not cut off: a sixth more or
    # less of them moves a variance by a third, and the mean of variances by 8 %.
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(times * STATED, rel=0.1)


def places(wave_px: float, length: float, noise_px: float = 0.0, trend_px: float = 0.0) -> Floats:
    """Return how far places scatter, (rows, columns): waves across rays, noise by pixel and a trend."""
    rig = cameras()
    points = np.moveaxis(seen_by(rig[0], curved).points, 0, -1)
    place = np.moveaxis(project(rig[1].intrinsics, rig[1].pose, points), -1, 0).copy()
    x = np.arange(place.shape[2])
    place[1] += wave_px * np.sin(2.0 * np.pi * x / length) + trend_px * (x / x[-1]) ** 2
    place += np.random.default_rng(5).normal(0.0, noise_px, place.shape)
    return scatter_of_places(*rig, place, np.full_like(place, STATED**2), 2 * RADIUS)


def test_places_that_scatter_as_they_say_have_mean_squares_of_one() -> None:
    times = places(0.0, 100.0, STATED, trend_px=0.3)
    # Means of some 200 second differences, over 30 independent places, scatter by a third, and the largest of
    # three within a subset is one to two deviations above 1; the trend's differences are 0.02 px at most.
    assert 0.9 < float(np.mean(times)) < 1.6
    assert float(np.max(times)) < 2.0


@pytest.mark.parametrize("length", [17.0, 30.0, 60.0, 120.0])
def test_haze_that_spreading_leaves_is_told_whatever_its_length(length: float) -> None:
    """Waves along the rows of 0.1 px, ten deviations, are 50 times the variance.

    Half of the differences, those along the columns, do not see them, and the others hold at most 16 / 6 of
    their square in the mean: four thirds of 50 all about a pixel, and twice that where a wave is highest.
    """
    times = places(0.1, length)
    assert 0.2 * 50.0 < float(np.median(times)) < 8.0 / 3.0 * 50.0 * 1.05


def test_what_is_near_haze_may_be_in_it() -> None:
    """Haze ends at column 150: differences see it 3 subsets of 17 px on, windows 2, and 1.5 are added."""
    rig = cameras()
    points = np.moveaxis(seen_by(rig[0], curved).points, 0, -1)
    place = np.moveaxis(project(rig[1].intrinsics, rig[1].pose, points), -1, 0).copy()
    x = np.arange(place.shape[2])
    place[1] += np.where(x < 150, 0.1 * np.sin(2.0 * np.pi * x / 30.0), 0.0)
    place += np.random.default_rng(5).normal(0.0, STATED, place.shape)
    times = np.median(scatter_of_places(*rig, place, np.full_like(place, STATED**2), 2 * RADIUS), axis=0)
    # Without the last 1.5 it is 1.2 at column 245.
    assert times[245] > 2.2
    assert times[290] < 2.0


def test_what_all_are_off_by_is_no_scatter_whatever_their_deviations() -> None:
    """A camera has moved by 50 deviations, and these change by four from one side to the other."""
    rig = cameras()
    points = np.moveaxis(seen_by(rig[0], curved).points, 0, -1)
    place = np.moveaxis(project(rig[1].intrinsics, rig[1].pose, points), -1, 0).copy()
    deviation = np.linspace(STATED, 4.0 * STATED, place.shape[2]) * np.ones(place.shape)
    place += np.random.default_rng(7).normal(0.0, 1.0, place.shape) * deviation
    place[1] += 50.0 * STATED
    assert float(np.max(scatter_of_places(*rig, place, deviation**2, 2 * RADIUS))) < 2.0
    found = matches(lambda x: STATED + 0.0 * x, lambda x: 50.0 * STATED + 0.0 * x, misfit=100.0)
    found.matches.sigma[:] *= 1.0 + 3.0 * (found.x / rig[0].columns)[:, None]
    _, sigma = stated(found)
    # As if they were not off: scatter is STATED, and deviations are stated a fourth to once as large.
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(STATED, rel=0.1)


def test_where_nothing_is_seen_no_scatter_is_told() -> None:
    rig = cameras()
    shape = (2, rig[0].rows, rig[0].columns)
    assert np.isnan(scatter_of_places(*rig, np.full(shape, np.nan), np.ones(shape), RADIUS)).all()


def test_few_matches_tell_nothing() -> None:
    found = matches(lambda x: 0.05 + 0.0 * x, lambda x: 0.0 * x)
    found.matches.ending[found.y > 20] = NOT_CONVERGED
    found.matches.ending[found.x > 20] = NOT_CONVERGED
    _, sigma = stated(found)
    np.testing.assert_allclose(sigma, in_partner(found))
