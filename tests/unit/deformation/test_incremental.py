"""Points are followed through states that the reference alone cannot reach, and their errors are stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sms_jobs.metrology.deformation.matching import correlation
from sms_jobs.metrology.deformation.matching.correlation import (
    Matches,
    MatchSettings,
    Noise,
    PreparedImages,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_nodes
from sms_jobs.metrology.deformation.matching.incremental import (
    Followed,
    compose,
    composed_sigma,
    follow,
    match_in_steps,
)
from sms_jobs.metrology.deformation.matching.sampling import Nodes, sample_nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings

SIZE, MIDDLE, RADIUS = 128, 63.5, 46.0
NOISE = 10.0  # grey levels, of a contrast of 150
HOW = MatchSettings(10), GridSettings(8), SearchSettings(20, 20)


def affine(warp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return displacement and gradient of a warp of six numbers."""
    return warp[[0, 3]], np.array([[warp[1], warp[2]], [warp[4], warp[5]]])


def test_composed_warps_are_one_after_the_other(rng: np.random.Generator) -> None:
    first, second = rng.normal(0.0, 0.2, (2, 1, 6))
    total = compose(first, second)[0]
    (d1, g1), (d2, g2), (d, g) = (affine(w) for w in (first[0], second[0], total))
    # A point at h goes to d1 + (1 + g1) h, and from there, d1 being the second warp's origin, on.
    for h in rng.normal(0.0, 5.0, (5, 2)):
        after_first = d1 + h + g1 @ h
        offset = after_first - d1
        # Rounding.
        np.testing.assert_allclose(d + h + g @ h, after_first + d2 + g2 @ offset, atol=1e-12)


def test_the_sigma_of_composed_warps_is_their_scatter(rng: np.random.Generator) -> None:
    first, second = rng.normal(0.0, 0.3, (2, 6))
    sigma1, sigma2 = np.array([0.02, 0.05]), np.array([0.03, 0.01])
    repeats = 20_000
    start = rng.normal(0.0, sigma1, (repeats, 2))
    _, gradient = affine(second)
    # Displacement after an end that is off by `start`: the second step carries it on by its slope.
    end = start + start @ gradient.T + rng.normal(0.0, sigma2, (repeats, 2))
    stated = composed_sigma(sigma1[None], second[None], sigma2[None], np.zeros(1))[0]
    # 1 / sqrt(2 x 20,000) = 0.5 %, four times.
    np.testing.assert_allclose(end.std(axis=0), stated, rtol=0.02)
    assert np.isfinite(compose(first[None], second[None])).all()


@dataclass(frozen=True)
class Series:
    """Images of a disc that turns and stretches, and which pixels it covers."""

    maps: list[np.ndarray]
    images: list[np.ndarray]
    labels: list[np.ndarray]
    nodes: Nodes

    def prepared(self, first: int, second: int) -> PreparedImages:
        noise = Noise(NOISE**2, 0.0)
        return prepare_images(self.images[first], self.images[second], self.labels[first], (noise, noise))

    def errors(self, found: Matches, state: int) -> np.ndarray:
        place = np.stack([self.nodes.x - MIDDLE, self.nodes.y - MIDDLE])
        truth = ((self.maps[state] - np.eye(2)) @ place).T
        return found.warp[:, [0, 3]] - truth


def turned(degrees: float, stretch: float) -> np.ndarray:
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return turn @ np.diag([1.0 + stretch, 1.0 - 0.3 * stretch])


@pytest.fixture(scope="module")
def series(speckle) -> Series:
    """Return five states, each turned by 9 degrees and stretched by 2 % more than the one before."""
    pattern = speckle.random(3, SIZE, width=1.8, margin=40)
    rng = np.random.default_rng(9)
    maps = [turned(9.0 * k, 0.02 * k) for k in range(5)]
    images, labels = [], []
    y, x = np.mgrid[0:SIZE, 0:SIZE] - MIDDLE
    for forward in maps:
        b = np.linalg.inv(forward)
        at_x, at_y = b[0, 0] * x + b[0, 1] * y, b[1, 0] * x + b[1, 1] * y
        grey = pattern.at(at_x + MIDDLE, at_y + MIDDLE)
        images.append(grey + rng.normal(0.0, NOISE, grey.shape))
        labels.append((np.hypot(at_x, at_y) < RADIUS).astype(np.int32))
    return Series(maps, images, labels, sample_nodes(labels[0], 8))


def start_of(found: Matches, steps: np.ndarray) -> Followed:
    return Followed(np.where(steps[:, None] > 0, found.warp[:, :6], np.nan), found.sigma, steps)


def ended_well(found: Matches) -> np.ndarray:
    return found.ending == correlation.CONVERGED


@pytest.fixture(scope="module")
def first_step(series: Series) -> Followed:
    found = match_nodes(series.prepared(0, 1), series.images[1], series.nodes, *HOW).matches
    assert ended_well(found).all()
    return start_of(found, np.ones(len(series.nodes.x), np.int32))


def test_the_reference_is_reached_where_it_cannot_be_found_directly(
    series: Series, first_step: Followed
) -> None:
    before = first_step
    for state in (2, 3, 4):
        images, image = series.prepared(0, state), series.images[state]
        grid, steps = match_in_steps(
            images, series.prepared(state - 1, state), image, series.nodes, before, *HOW
        )
        found, good = grid.matches, ended_well(grid.matches)
        assert good.mean() > 0.95
        assert (steps[good] == 1).all()
        before = start_of(found, steps)
    alone = match_nodes(series.prepared(0, 4), series.images[4], series.nodes, *HOW).matches
    assert ended_well(alone).mean() < 0.1
    error = series.errors(found, 4)[good]
    # No error adds up: the scatter is that of a single match. About 90 subsets that overlap tell it to 15 %.
    assert 0.7 < np.sqrt(np.mean((error / found.sigma[good]) ** 2)) < 1.3
    assert np.abs(error).max() < 0.15


def test_displacements_add_up_and_so_do_their_errors(series: Series, first_step: Followed) -> None:
    before = first_step
    sigmas = [np.median(before.sigma)]
    for state in (2, 3, 4):
        found, steps = follow(
            series.prepared(state - 1, state), series.images[state], series.nodes, before, *HOW
        )
        good = ended_well(found)
        assert good.mean() > 0.9
        assert (steps[good] == state).all()
        assert (steps[~good] == 0).all()
        before = start_of(found, steps)
        sigmas.append(np.median(found.sigma[good]))
    error = series.errors(found, 4)[good]
    # Each step adds its variance less the part that its image shares with the step before: 9 degrees and 2 %
    # lose 9 % of the square, a whole pixel's rounding 2.5 %, which leaves 35 % of the variance.
    growth = np.array(sigmas) ** 2 / sigmas[0] ** 2
    np.testing.assert_allclose(growth, [1.0, 1.35, 1.7, 2.05], rtol=0.15)
    # The required 20 %, and 15 % for some 90 subsets that overlap.
    assert 0.7 < np.sqrt(np.mean((error / found.sigma[good]) ** 2)) < 1.35


def test_what_was_lost_stays_lost_and_what_leaves_says_so(series: Series, first_step: Followed) -> None:
    warp, steps = first_step.warp.copy(), first_step.steps.copy()
    warp[0], steps[0] = np.nan, 0
    warp[1, 0] = 500.0  # beyond the image
    warp[2, [0, 3]] = [2.0 - series.nodes.x[2], 2.0 - series.nodes.y[2]]  # a corner, where no disc is
    before = Followed(warp, first_step.sigma, steps)
    found, counted = follow(series.prepared(1, 2), series.images[2], series.nodes, before, *HOW)
    np.testing.assert_array_equal(
        found.ending[:3], [correlation.NOT_CONVERGED, correlation.LEFT_IMAGE, correlation.TOO_FEW_PIXELS]
    )
    assert np.isnan(found.warp[:3]).all()
    assert (counted[:3] == 0).all()
    assert ended_well(found)[3:].mean() > 0.9


def test_one_state_that_does_not_move_is_no_step_at_all(series: Series) -> None:
    nodes = series.nodes
    none = Followed(np.zeros((len(nodes.x), 6)), np.zeros((len(nodes.x), 2)), np.ones(len(nodes.x), np.int32))
    direct = match_nodes(series.prepared(0, 1), series.images[1], nodes, *HOW).matches
    found, _ = follow(series.prepared(0, 1), series.images[1], nodes, none, *HOW)
    np.testing.assert_allclose(found.warp, direct.warp)
    assert (found.sigma <= direct.sigma).all()


def test_threads_do_not_matter(series: Series, first_step: Followed) -> None:
    one, two = (
        match_in_steps(
            series.prepared(0, 2), series.prepared(1, 2), series.images[2], series.nodes, first_step, *HOW, n
        )
        for n in (1, 2)
    )
    np.testing.assert_array_equal(one[1], two[1])
    for a, b in zip(vars(one[0].matches).values(), vars(two[0].matches).values(), strict=True):
        np.testing.assert_array_equal(a, b)
