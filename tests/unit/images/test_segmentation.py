"""Segmentation: regions end at discontinuities, and only there."""

from __future__ import annotations

from math import pi, tan
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.images.segmentation import (
    ContinuousRegions,
    EdgeSettings,
    distant_neighbours,
    find_discontinuities,
    label_regions,
    pixel_footprint,
    surface_gradient,
)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROWS, COLUMNS = 48, 64
PIXEL = 0.8  # footprint in mm
NOISE = 0.02  # mm
Y, X = np.indices((ROWS, COLUMNS)).astype(float)
ALL = np.ones((ROWS, COLUMNS), dtype=bool)


def surface(height: Floats, rng: np.random.Generator | None = None) -> Floats:
    """Return xyz of a surface seen from far above, height in mm."""
    xyz = np.stack([X * PIXEL, Y * PIXEL, height])
    return xyz if rng is None else xyz + rng.normal(scale=NOISE, size=xyz.shape)


def segment(
    xyz: Floats,
    valid: Mask = ALL,
    minimum_area: int = 20,
    threads: int = 1,
    edges: EdgeSettings = EdgeSettings(),  # noqa: B008
) -> ContinuousRegions:
    sigma, footprint = np.full(valid.shape, NOISE), np.full(valid.shape, PIXEL)
    return label_regions(
        xyz, valid, sigma, footprint, minimum_area=minimum_area, edges=edges, threads=threads
    )


def marked(xyz: Floats, edges: EdgeSettings, valid: Mask = ALL) -> Mask:
    sigma, footprint = np.full(valid.shape, NOISE), np.full(valid.shape, PIXEL)
    return find_discontinuities(xyz, valid, sigma, footprint, edges=edges)


def test_gradients_are_the_least_squares_slopes(rng: np.random.Generator) -> None:
    xyz = surface(0.3 * X**1.5 - 0.2 * Y, rng)
    valid = rng.random((ROWS, COLUMNS)) > 0.2
    found = surface_gradient(xyz, valid, half_width=2)
    for row, column in [(10, 10), (0, 5), (20, 0), (47, 63), (30, 33)]:
        lines = ((xyz[:, row], valid[row], column), (xyz[:, :, column], valid[:, column], row))
        for axis, (points, good, middle) in enumerate(lines):
            k = np.arange(max(middle - 2, 0), min(middle + 3, good.size))
            k = k[good[k]]
            if not good[middle] or k.size < 2:
                assert np.isnan(found[axis, row, column])
                continue
            slope = np.polyfit(k.astype(float), points[:, k].T, 1)[0]
            # Rounding.
            assert found[axis, row, column] == pytest.approx(np.linalg.norm(slope), rel=1e-9)


def one_sided(xyz: Floats, valid: Mask, start: tuple[int, int], step: tuple[int, int]) -> Floats:
    """Return the slope of a line through the valid of three pixels from a start on; NaN for one alone."""
    at = [(k, start[0] + k * step[0], start[1] + k * step[1]) for k in range(3)]
    seen = [(k, r, c) for k, r, c in at if 0 <= r < ROWS and 0 <= c < COLUMNS and valid[r, c]]
    if len(seen) < 2:
        return np.full(3, np.nan)
    return np.polyfit([k for k, _, _ in seen], [xyz[:, r, c] for _, r, c in seen], 1)[0]


def jumps(xyz: Floats, valid: Mask, limit: float) -> Mask:
    """Return the pixels beside jumps as the head of `segmentation` has them, pair by pair."""
    found = np.zeros_like(valid)
    for step in ((0, 1), (1, 0), (1, 1), (1, -1)):
        for r, c in np.argwhere(valid):
            other = r + step[0], c + step[1]
            if not (other[0] < ROWS and 0 <= other[1] < COLUMNS and valid[other]):
                continue
            gap, allowed = xyz[:, *other] - xyz[:, r, c], limit * np.hypot(*step)
            before = -one_sided(xyz, valid, (r, c), (-step[0], -step[1]))
            after = one_sided(xyz, valid, other, step)
            if np.isfinite(before + after).all():
                allowed = min(allowed, 1.5 * max(np.linalg.norm(before), np.linalg.norm(after)))
                gap = gap - 0.5 * (before + after)
            if np.linalg.norm(gap) > allowed + 7.2 * NOISE:
                found[r, c] = found[other] = True
    return found


@pytest.mark.parametrize("missing", [0.0, 0.04, 0.3])
def test_jumps_are_found_pair_by_pair(missing: float, rng: np.random.Generator) -> None:
    """Pairs whose neighbours are all there go through a loop of their own, between others that do not."""
    steps = rng.uniform(0.0, 6.0, (ROWS // 8, COLUMNS // 8)).repeat(8, axis=0).repeat(8, axis=1)
    xyz = surface(0.2 * X + steps, rng)
    valid = rng.random((ROWS, COLUMNS)) >= missing
    xyz[:, ~valid] = np.nan
    edges = EdgeSettings(maximum_slope_rad=1.5)
    limit = PIXEL / np.cos(edges.maximum_slope_rad)
    with np.errstate(invalid="ignore"):
        steep = (surface_gradient(xyz, valid) >= limit).any(axis=0)
    expected = jumps(xyz, valid, limit)
    assert 0.05 < expected.mean() < 0.95
    np.testing.assert_array_equal(marked(xyz, edges, valid), expected | steep)


def test_an_invalid_pixel_has_no_gradient() -> None:
    valid = ALL.copy()
    valid[5, 7] = False
    gradient = surface_gradient(surface(np.zeros_like(X)), valid)
    assert np.isnan(gradient[:, 5, 7]).all()
    assert np.isnan(gradient).sum() == 2


def test_distant_neighbours_are_those_of_the_thesis(rng: np.random.Generator) -> None:
    xyz, valid = surface(rng.normal(size=X.shape)), rng.random(X.shape) > 0.2
    found, expected = distant_neighbours(xyz, valid, np.full(X.shape, 1.3)), np.zeros_like(valid)
    for row in range(ROWS):
        for column in range(COLUMNS):
            for r, c in ((row, column + 1), (row + 1, column)):
                if r < ROWS and c < COLUMNS and valid[row, column] and valid[r, c]:
                    far = np.linalg.norm(xyz[:, r, c] - xyz[:, row, column]) >= 1.3
                    expected[row, column] |= far
                    expected[r, c] |= far
    np.testing.assert_array_equal(found, expected)
    assert 0.1 < found.mean() < 0.9


@pytest.mark.parametrize("p", [2, 4])
def test_of_a_step_a_slope_sees_less_the_longer_it_is_and_a_distance_all(p: int) -> None:
    # Of a step of 1 a line through 2 p + 1 pixels beside it has the slope 1.5 / (2 p + 1): sum of 1 .. p over
    # that of k^2. 0.3 for p = 2. The limit at 60 degrees is two footprints, of which one is across.
    limit = np.sqrt(3.0) * PIXEL
    slope = EdgeSettings("gradient", p, pi / 3)
    for part, is_found in ((0.99, False), (1.01, True)):
        height = np.where(X > 31, part * limit * (2 * p + 1) / 1.5, 0.0)
        assert marked(surface(height), slope)[:, 31:33].all() == is_found
        assert marked(surface(height), slope).any() == is_found
        height = np.where(X > 31, part * limit, 0.0)
        by_distance = marked(surface(height), EdgeSettings("distance", maximum_slope_rad=pi / 3))
        np.testing.assert_array_equal(by_distance, is_found & ((X == 31) | (X == 32)))
        # The same distance in mm.
        in_mm = marked(surface(height), EdgeSettings("distance", distance=2.0 * PIXEL))
        np.testing.assert_array_equal(in_mm, by_distance)


def test_a_slope_steeper_than_the_limit_is_no_region() -> None:
    steep = surface(X * PIXEL * tan(0.9))
    for test in ("gap", "gradient", "distance"):
        assert (segment(steep, edges=EdgeSettings(test, maximum_slope_rad=0.91)).labels == 1).all()
        assert not segment(steep, edges=EdgeSettings(test, maximum_slope_rad=0.89)).labels.any()


@pytest.mark.parametrize("test", ["gradient", "distance"])
def test_the_thesiss_tests_part_a_high_step_at_its_edge_too(
    test: Literal["gradient", "distance"], rng: np.random.Generator
) -> None:
    for angle in (0.0, 0.3, pi / 4, pi / 2):
        high = (X - 31.3) * np.cos(angle) + (Y - 23.4) * np.sin(angle) > 0.0
        labels = segment(surface(np.where(high, 30.0 * PIXEL, 0.0), rng), edges=EdgeSettings(test)).labels
        assert {*labels[high]} | {*labels[~high]} == {1, 2}
        assert len({*labels[high]}) == len({*labels[~high]}) == 1


@pytest.mark.parametrize("degrees", [0.0, 45.0, 63.4, 75.0])
def test_a_slope_is_no_discontinuity(degrees: float, rng: np.random.Generator) -> None:
    xyz = surface(X * PIXEL * tan(degrees * pi / 180.0), rng)
    found = segment(xyz)
    assert (found.labels == 1).all()


def test_the_sides_of_a_top_hat_belong_to_it(rng: np.random.Generator) -> None:
    # Four creases of 63 degrees, at odd places between the pixels: the thesis's specimen is one sheet.
    breaks = np.array([0.0, 13.3, 22.7, 40.1, 49.6, 63.0])
    height = np.interp(X, breaks, PIXEL * 2.0 * 9.4 * np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0]))
    for xyz in (surface(height), surface(height, rng)):
        found = segment(xyz)
        assert (found.labels == 1).all()


@pytest.mark.parametrize("step", [2.0, 5.0, 100.0])
@pytest.mark.parametrize("angle", [0.0, 0.3, pi / 4, pi / 2])
def test_a_step_parts_two_planes_at_its_edge(step: float, angle: float, rng: np.random.Generator) -> None:
    # From two footprints on; along the rows, the diagonal and between.
    high = (X - 31.3) * np.cos(angle) + (Y - 23.4) * np.sin(angle) > 0.0
    found = segment(surface(np.where(high, step * PIXEL + 0.1 * X, 0.1 * X), rng))
    assert len(found.areas) == 2
    on_high = found.labels[high]
    on_low = found.labels[~high]
    # Every pixel is given back to its own side.
    assert (on_high == on_high[0]).all()
    assert (on_low == on_low[0]).all()
    assert on_high[0] != on_low[0]


def test_planes_that_touch_at_a_corner_stay_apart() -> None:
    # Two squares of one label each and two invalid ones: they meet only across a diagonal.
    left_up = (X < 32) & (Y < 24)
    right_down = (X >= 32) & (Y >= 24)
    found = segment(surface(np.where(right_down, 30.0, 0.0)), left_up | right_down)
    assert len(found.areas) == 2
    assert len(np.unique(found.labels[left_up])) == 1
    assert (found.labels[~(left_up | right_down)] == 0).all()


def test_one_plane_through_a_diagonal_stays_together() -> None:
    valid = ((X < 32) & (Y < 24)) | ((X >= 32) & (Y >= 24))
    assert len(segment(surface(np.zeros_like(X)), valid).areas) == 1


def test_mixed_pixels_along_an_edge_do_not_bridge_it(rng: np.random.Generator) -> None:
    height = np.where(X > 30, 60.0, 0.0)
    height[:, 31] = rng.uniform(0.0, 60.0, size=ROWS)
    found = segment(surface(height, rng))
    assert len(found.areas) == 2
    assert found.labels[0, 0] != found.labels[0, -1]


def test_regions_are_ordered_by_area_then_centroid_and_small_ones_dropped() -> None:
    valid = np.zeros((ROWS, COLUMNS), dtype=bool)
    valid[2:12, 40:50] = valid[30:40, 5:15] = True  # equal areas: the left one comes first
    valid[20:40, 30:60] = True  # the largest
    valid[2:5, 2:5] = True  # too small
    found = segment(surface(np.zeros_like(X)), valid)
    np.testing.assert_array_equal(found.areas, [600, 100, 100])
    np.testing.assert_allclose(found.centroids, [[44.5, 29.5], [9.5, 34.5], [44.5, 6.5]])
    assert found.labels[25, 40] == 1
    assert found.labels[35, 10] == 2
    assert found.labels[5, 45] == 3
    assert (found.labels[2:5, 2:5] == 0).all()


@pytest.mark.parametrize("place", [(0, 0), (7, 12), (18, 34), (9, 34)])
@pytest.mark.parametrize("half_width", [2, 3])
def test_regions_are_the_same_wherever_they_lie(
    place: tuple[int, int], half_width: int, rng: np.random.Generator
) -> None:
    """Of a step, in pieces of 30 x 30 px; what lies beyond the image and what is not valid are nothing."""
    edges = EdgeSettings(half_width=half_width)
    step = np.where(np.arange(30) < 13, 0.0, 6.0) + 0.2 * np.arange(30)[:, None]
    points = np.stack([*(PIXEL * one for one in np.mgrid[:30.0, :30.0][::-1]), step])
    points += rng.normal(scale=NOISE, size=points.shape)
    good = rng.random((30, 30)) > 0.03
    alone = segment(points, good, edges=edges)
    assert len(alone.areas) == 2
    xyz, valid = np.full((3, ROWS, COLUMNS), np.nan), np.zeros((ROWS, COLUMNS), bool)
    own = np.s_[place[0] : place[0] + 30, place[1] : place[1] + 30]
    xyz[:, *own], valid[own] = points, good
    found = segment(xyz, valid, edges=edges)
    np.testing.assert_array_equal(found.labels[own], alone.labels)
    assert np.count_nonzero(found.labels) == np.count_nonzero(alone.labels)
    np.testing.assert_allclose(found.centroids, alone.centroids + np.array(place[::-1]), atol=1e-9)


def test_noise_alone_marks_nothing(rng: np.random.Generator) -> None:
    # Even where a pixel is as small as the noise: 7.2 sigma of difference, see the module.
    xyz = np.stack([X * NOISE, Y * NOISE, np.zeros_like(X)]) + rng.normal(
        scale=NOISE, size=(3, ROWS, COLUMNS)
    )
    sigma = np.full(ALL.shape, NOISE * np.sqrt(3.0))
    marked = find_discontinuities(xyz, ALL, sigma, np.full(ALL.shape, NOISE))
    assert not marked.any()


def test_threads_change_nothing(rng: np.random.Generator) -> None:
    xyz = np.tile(surface(np.where(X > 30, 9.0, 0.0), rng), (1, 2, 1))
    valid = np.tile(ALL, (2, 1))
    np.testing.assert_array_equal(segment(xyz, valid).labels, segment(xyz, valid, threads=2).labels)


def test_nothing_valid_gives_no_region() -> None:
    found = segment(surface(np.full_like(X, np.nan)), ~ALL)
    assert found.areas.size == 0
    assert (found.labels == 0).all()


def test_the_footprint_is_what_one_pixel_spans() -> None:
    lens = Intrinsics(1000.0, 1000.0, 10.0, 10.0)
    pose = Pose.looking_at(np.array([0.0, 0.0, -500.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    xyz = np.zeros((3, 1, 2))
    xyz[2, 0] = [0.0, 300.0]
    np.testing.assert_allclose(pixel_footprint(xyz, lens, pose), [[0.5, 0.8]])
