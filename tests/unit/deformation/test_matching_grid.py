"""A grid of points is matched from few seeds, each region by itself, whatever the number of threads."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.deformation.matching.correlation import CONVERGED, MatchSettings, prepare_images
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.sampling import choose_seeds, sample_nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings

SIZE = 128
SETTINGS = MatchSettings(radius=8), GridSettings(spacing=4), SearchSettings(30, 10, template_radius=12)


@pytest.fixture(scope="module")
def parted(speckle):
    """Return two halves that move 18 px left and 11 px right, the right one stretched by 2 %."""
    pattern = speckle.random(21, SIZE)
    labels = np.ones((SIZE, SIZE), np.int32)
    labels[:, SIZE // 2 :] = 2
    labels[:, SIZE // 2 - 3 : SIZE // 2 + 3] = 0
    left = pattern.image(SIZE, lambda x, y: (x + 18.3, y - 0.4))
    right = pattern.image(SIZE, lambda x, y: (SIZE / 2 + (x - 11.2 - SIZE / 2) / 1.02, y))
    deformed = np.where(np.arange(SIZE) < SIZE // 2 + 5, left, right)
    return pattern.image(SIZE), deformed, labels


def inside(found, margin: int) -> np.ndarray:
    """Return which points lie so many pixels inside the image."""
    lower, upper = np.minimum(found.x, found.y), np.maximum(found.x, found.y)
    return (lower >= margin) & (upper < SIZE - margin)


def test_nodes_lie_on_regions_and_seeds_deep_inside() -> None:
    labels = np.zeros((70, 130), np.int32)
    labels[10:60, 5:60] = 1
    labels[10:60, 60:125] = 2
    nodes = sample_nodes(labels, 5)
    x, y = nodes.x, nodes.y
    # Every fifth pixel of every fifth row, row by row, where a region is.
    np.testing.assert_array_equal(np.argwhere(labels[2::5, 2::5] > 0) * 5 + 2, np.stack([y, x], axis=1))
    seeds = choose_seeds(labels, x, y, SearchSettings(spacing=64))
    # Squares of 64 px: region 1 lies in one column of them, region 2 in two; the edge at 64 is in both.
    assert sorted(labels[y[seeds], x[seeds]]) == [1, 2, 2]
    assert (np.abs(x[seeds] - 59.5) > 2).all()


def test_nodes_are_denser_near_edges_and_know_their_neighbours() -> None:
    labels = np.zeros((60, 80), np.int32)
    labels[10:50, :40] = 1
    labels[10:50, 40:70] = 2
    regular, refined = sample_nodes(labels, 8), sample_nodes(labels, 8, 2)
    every = set(zip(refined.x, refined.y, strict=True))
    # Refining takes no node away, and adds those of the finer grid up to 8 px from an edge of a region.
    assert set(zip(regular.x, regular.y, strict=True)) < every
    assert len(every) == len(refined.x)
    added = every - set(zip(regular.x, regular.y, strict=True))
    inside = [(x, y) for x in range(0, 80, 2) for y in range(0, 60, 2) if labels[y, x] > 0]
    edges = [10 - 0.5, 50 - 0.5], [40 - 0.5, 70 - 0.5]
    for x, y in inside:
        off = min(*(abs(y - e) for e in edges[0]), *(abs(x - e) for e in edges[1]))
        if off < 7.0:
            assert (x, y) in every
        if off > 9.0:
            assert (x, y) not in added
    # Neighbours are on the region, the first ring about the node, and neighbourhood goes both ways.
    for k in range(len(refined.x)):
        near = refined.around[k][refined.around[k] >= 0]
        assert (labels[refined.y[near], refined.x[near]] == labels[refined.y[k], refined.x[k]]).all()
        assert all(k in refined.around[other] for other in near)
        ring = refined.around[k, :8]
        ring = ring[ring >= 0]
        assert (
            np.maximum(np.abs(refined.x[ring] - refined.x[k]), np.abs(refined.y[ring] - refined.y[k])) <= 8
        ).all()


def test_a_refined_grid_is_matched_throughout(parted) -> None:
    reference, deformed, labels = parted
    grid = GridSettings(spacing=8, edge_spacing=2)
    found = match_grid(prepare_images(reference, deformed, labels), deformed, SETTINGS[0], grid, SETTINGS[2])
    stays = (found.x > 34) & (found.x < SIZE - 24) & inside(found, 8)
    assert (found.matches.ending == CONVERGED)[stays].all()
    region = labels[found.y, found.x]
    u = np.where(region == 1, -18.3, 11.2 + 0.02 * (found.x - SIZE / 2))
    # As on the regular grid.
    assert np.abs(found.matches.warp[:, 0] - u)[stays].max() < 0.01


def test_regions_that_part_are_matched_to_the_edge(parted) -> None:
    reference, deformed, labels = parted
    found = match_grid(prepare_images(reference, deformed, labels), deformed, *SETTINGS)
    matches = found.matches
    good = matches.ending == CONVERGED
    region = labels[found.y, found.x]
    stays = (found.x > 34) & (found.x < SIZE - 24) & inside(found, 8)  # whose subset does not leave the image
    assert good[stays].all()
    u = np.where(region == 1, -18.3, 11.2 + 0.02 * (found.x - SIZE / 2))
    v = np.where(region == 1, 0.4, 0.0)
    # The spline's error, ten times as much for the half subsets at the edges; the outermost points of the
    # image are carried over its rim.
    well = good & inside(found, 8)
    assert np.abs(matches.warp[:, 0] - u)[well].max() < 0.01
    assert np.abs(matches.warp[:, 3] - v)[well].max() < 0.01
    assert matches.iterations[good].mean() < 3.0


def test_threads_do_not_matter(parted) -> None:
    reference, deformed, labels = parted
    images = prepare_images(reference, deformed, labels)
    one = match_grid(images, deformed, *SETTINGS, threads=1).matches
    two = match_grid(images, deformed, *SETTINGS, threads=2).matches
    for a, b in zip(vars(one).values(), vars(two).values(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_patch_that_changed_is_not_matched_and_harms_nobody(speckle) -> None:
    pattern = speckle.random(4, SIZE)
    reference = pattern.image(SIZE)
    deformed = pattern.image(SIZE, lambda x, y: (x - 1.3, y))
    deformed[50:80, 50:80] = speckle.random(77, SIZE).image(SIZE)[50:80, 50:80]
    labels = np.ones((SIZE, SIZE), np.int32)
    found = match_grid(prepare_images(reference, deformed, labels), deformed, *SETTINGS)
    good = found.matches.ending == CONVERGED
    middle = (np.abs(found.x - 65) < 10) & (np.abs(found.y - 65) < 10)
    away = (np.abs(found.x - 65) > 26) | (np.abs(found.y - 65) > 26)
    assert not good[middle].any()
    assert good[away & inside(found, 12)].all()
    # Subsets that see a little of the patch are pulled by it, but not beyond what their residual tells:
    # five deviations of at most 0.05 px.
    assert np.abs(found.matches.warp[good, 0] - 1.3).max() < 0.25


def test_nothing_to_match_gives_nothing() -> None:
    blank = np.full((64, 64), 100.0)
    empty = np.zeros((64, 64), np.int32)
    assert len(match_grid(prepare_images(blank, blank, empty), blank, *SETTINGS).x) == 0
    found = match_grid(prepare_images(blank, blank, empty + 1), blank, *SETTINGS)
    assert not (found.matches.ending == CONVERGED).any()
