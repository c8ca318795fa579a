"""What cannot be matched says why: each scenario ends with a reason per point and without an exception."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    LEFT_IMAGE,
    NO_TEXTURE,
    NOT_CONVERGED,
    TOO_FEW_PIXELS,
    Matches,
    MatchSettings,
    Noise,
    blank_matches,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.doubtful import check_again, outliers
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.sampling import Nodes, sample_nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings

SIZE = 128
HOW = MatchSettings(radius=8), GridSettings(spacing=6), SearchSettings(50, 20, template_radius=12)
NOISE = (Noise(4.0, 0.0),) * 2


@pytest.fixture(scope="module")
def pattern(speckle):
    return speckle.random(41, SIZE)


def matched(reference: np.ndarray, deformed: np.ndarray, labels: np.ndarray) -> GridMatches:
    return match_grid(prepare_images(reference, deformed, labels, NOISE), deformed, *HOW)


def in_a_corner(found: GridMatches) -> np.ndarray:
    """Return which subsets have too few pixels because the image ends on two sides of them."""
    return (np.abs(found.x - 63.5) > 58) & (np.abs(found.y - 63.5) > 58)


def only_the_good_have_values(found: GridMatches) -> None:
    good = found.matches.ending == CONVERGED
    np.testing.assert_array_equal(np.isfinite(found.matches.sigma).all(axis=1) | ~good, True)
    assert np.isfinite(found.matches.warp[good]).all()


def test_no_texture_is_told_where_there_is_none(pattern) -> None:
    reference = pattern.image(SIZE)
    reference[30:100, 30:100] = 3000.0
    found = matched(reference, reference, np.ones((SIZE, SIZE), np.int32))
    blank = (np.abs(found.x - 64.5) < 26) & (np.abs(found.y - 64.5) < 26)
    assert (found.matches.ending[blank] == NO_TEXTURE).all()
    away = (np.abs(found.x - 64.5) > 46) | (np.abs(found.y - 64.5) > 46)
    away &= ~in_a_corner(found)
    assert (found.matches.ending[away] == CONVERGED).all()
    only_the_good_have_values(found)


def test_images_without_anything_in_common_match_nowhere(pattern, speckle) -> None:
    other = speckle.random(42, SIZE).image(SIZE)
    found = matched(pattern.image(SIZE), other, np.ones((SIZE, SIZE), np.int32))
    # Chance would have to make 289 pixels agree to 0.8.
    assert (found.matches.ending[~in_a_corner(found)] == NOT_CONVERGED).all()
    only_the_good_have_values(found)


def test_what_left_the_view_says_so(pattern) -> None:
    deformed = pattern.image(SIZE, lambda x, y: (x - 45.0, y))
    found = matched(pattern.image(SIZE), deformed, np.ones((SIZE, SIZE), np.int32))
    ending = found.matches.ending
    gone = found.x + 45 > SIZE - 1
    assert (ending[gone] == LEFT_IMAGE).all()
    stays = (found.x + 45 < SIZE - 12) & (np.minimum(found.x, found.y) > 12) & (found.y < SIZE - 12)
    assert (ending[stays] == CONVERGED).all()
    only_the_good_have_values(found)


def test_a_region_that_parts_is_matched_on_both_sides(pattern) -> None:
    """A crack opens by 3 px within one region: only subsets across it are lost."""
    right = pattern.image(SIZE, lambda x, y: (x - 3.0, y))
    deformed = np.where(np.arange(SIZE) < 66, pattern.image(SIZE), right)
    deformed[:, 64:67] = 3000.0
    found = matched(pattern.image(SIZE), deformed, np.ones((SIZE, SIZE), np.int32))
    good = found.matches.ending == CONVERGED
    inner = (np.minimum(found.x, found.y) > 12) & (np.maximum(found.x, found.y) < SIZE - 16)
    away = np.abs(found.x - 64) > 10
    assert good[inner & away].all()
    u = np.where(found.x < 64, 0.0, 3.0)
    # The spline's error.
    assert np.abs(found.matches.warp[:, 0] - u)[good & away & inner].max() < 0.01
    assert (found.matches.ending[inner & ~good] == NOT_CONVERGED).all()
    only_the_good_have_values(found)


def test_regions_too_thin_to_match_say_so(pattern) -> None:
    labels = np.zeros((SIZE, SIZE), np.int32)
    labels[40:42] = 1
    found = match_grid(
        prepare_images(pattern.image(SIZE), pattern.image(SIZE), labels, NOISE),
        pattern.image(SIZE), HOW[0], GridSettings(spacing=1), HOW[2],
    )  # fmt: skip
    assert len(found.x) == 2 * SIZE
    assert (found.matches.ending != CONVERGED).all()
    assert TOO_FEW_PIXELS in found.matches.ending


def row_of_matches(u: np.ndarray) -> tuple[Matches, Nodes]:
    nodes = sample_nodes(np.ones((9, 3 * len(u)), np.int32), 3)
    found = blank_matches(len(nodes.x), 6)
    found.warp[:] = 0.0
    found.warp[:, 0] = np.tile(u, 3)
    found.sigma[:] = 0.001
    found.ending[:] = CONVERGED
    return found, nodes


def test_neighbours_that_were_not_matched_are_not_asked(rng: np.random.Generator) -> None:
    found, nodes = row_of_matches(rng.normal(0.5, 0.05, 12))
    found.ending[rng.random(len(nodes.x)) < 0.3] = NOT_CONVERGED
    u, judged = found.warp[:, 0], found.ending == CONVERGED
    expected = []
    for point in np.flatnonzero(judged):
        near = [k for k in nodes.around[point, :8] if k >= 0 and judged[k]]
        middle = np.median(u[near])
        scatter = np.median(np.abs(u[near] - middle))
        if len(near) >= 3 and abs(u[point] - middle) > 2.0 * max(scatter, 0.01):
            expected.append(point)
    assert 2 < len(expected) < len(u) // 2
    np.testing.assert_array_equal(outliers(found, nodes, np.arange(len(u)), 2.0), expected)


def test_a_doubtful_match_is_tried_again_from_its_neighbours(rng: np.random.Generator) -> None:
    found, nodes = row_of_matches(rng.normal(0.5, 0.002, 10))
    stray = 14
    found.warp[stray, 0] = 0.9
    np.testing.assert_array_equal(outliers(found, nodes, np.arange(len(nodes.x)), 6.0), [stray])
    asked = []

    def finds_it(points: np.ndarray, guess: np.ndarray) -> tuple[Matches, np.ndarray]:
        asked.append((points, guess))
        again = blank_matches(len(points), 6)
        again.warp[:] = guess
        again.sigma[:] = 0.001
        again.ending[:] = CONVERGED
        return again, np.ones(len(points), dtype=bool)

    check_again(found, nodes, 6.0, finds_it)
    ((points, guess),) = asked
    np.testing.assert_array_equal(points, [stray])
    # The median of eight deviates of 0.002 px.
    assert guess[0, 0] == pytest.approx(0.5, abs=0.006)
    assert (found.ending == CONVERGED).all()
    assert found.warp[stray, 0] == guess[0, 0]


def test_what_contradicts_its_neighbours_twice_is_no_match(rng: np.random.Generator) -> None:
    found, nodes = row_of_matches(rng.normal(0.5, 0.002, 10))
    found.warp[14, 0] = 0.9

    def insists(points: np.ndarray, guess: np.ndarray) -> tuple[Matches, np.ndarray]:
        again = blank_matches(len(points), 6)
        again.warp[:] = 0.0
        again.warp[:, 0] = 0.9
        again.sigma[:] = 0.001
        again.ending[:] = CONVERGED
        return again, np.ones(len(points), dtype=bool)

    check_again(found, nodes, 6.0, insists)
    np.testing.assert_array_equal(np.flatnonzero(found.ending == NOT_CONVERGED), [14])
