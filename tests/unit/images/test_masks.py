"""Masks keep the good pixels that they say they keep."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.images.masks import (
    alone,
    at_edge,
    beside_another_label,
    box_of,
    distance_inside,
    grown,
    high_phase_error,
    large_ray_gap,
    low_modulation,
    narrowed,
    of_one_label,
    outside_box,
    phase_error_factor,
    spots,
    wide_gaps,
    widened,
)


def test_limits_are_those_of_the_thesis() -> None:
    # Eq. (3.1): trusted below sigma_0; Eq. (3.2): trusted from mu_0 on.
    np.testing.assert_array_equal(high_phase_error(np.array([0.1, 0.2, 0.3]), 0.2), [False, True, True])
    np.testing.assert_array_equal(low_modulation(np.array([9.0, 10.0, 11.0]), 10.0), [True, False, False])


def test_a_box_holds_its_faces() -> None:
    xyz = np.zeros((3, 1, 4))
    xyz[:, 0] = np.array([[0, 0, 0], [1, 2, 3], [1, 2, 3.1], [-0.1, 0, 0]]).T
    np.testing.assert_array_equal(
        outside_box(xyz, (0.0, 0.0, 0.0), (1.0, 2.0, 3.0)), [[False, False, True, True]]
    )


def test_noise_and_calibration_share_the_ray_gap() -> None:
    gap = np.array([0.49, -0.49, 0.51, -0.51])
    np.testing.assert_array_equal(
        large_ray_gap(gap, np.full(4, 0.1), np.full(4, 0.075), sigmas=4.0), [False, False, True, True]
    )


def test_missing_values_fail_no_test() -> None:
    lost = np.full((1, 1), np.nan)
    assert not high_phase_error(lost, 0.1).any()
    assert not low_modulation(lost, 0.1).any()
    assert not outside_box(np.full((3, 1, 1), np.nan), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)).any()
    assert not large_ray_gap(lost, lost, lost, 4.0).any()


@pytest.mark.parametrize("fitted", [2, 3, 6])
def test_the_phase_error_factor_keeps_its_part(fitted: int, rng: np.random.Generator) -> None:
    t = np.arange(1.0, fitted + 1.0)
    phase = rng.normal(size=(200_000, fitted))
    omega = phase @ t / np.sum(t * t)
    error = np.sqrt(np.sum((phase - omega[:, None] * t) ** 2, axis=1) / (fitted - 1))
    # 0.99 of 200,000: binomial scatter 2e-4; four times that.
    assert np.mean(error < phase_error_factor(fitted, 0.99)) == pytest.approx(0.99, abs=1e-3)


def test_one_density_has_no_residual_to_judge() -> None:
    assert phase_error_factor(1, 0.999) == float("inf")


def test_pixels_beside_a_gap_are_at_the_edge_but_noise_is_no_gap() -> None:
    valid = np.zeros((20, 30), bool)
    valid[4:16, 5:25] = True
    valid[10, 12] = False  # a single pixel, lost to noise
    inner = np.zeros_like(valid)
    inner[5:15, 6:24] = True
    inner[10, 12] = False
    np.testing.assert_array_equal(valid & ~at_edge(valid, 4), inner)
    # With a smallest gap of one pixel the lost one is an edge too, and its eight neighbours go.
    assert (inner & at_edge(valid, 1)).sum() == 8


def test_a_gap_of_pixels_that_lie_within_a_surface_alone_is_no_edge() -> None:
    valid = np.ones((20, 30), bool)
    ring, shadow = np.s_[4:8, 4:8], np.s_[10:14, 15:20]
    valid[ring], valid[shadow] = False, False
    within = np.zeros_like(valid)
    within[ring], within[10, 15] = True, True  # a part of the shadow alone
    found = at_edge(valid, 4, within)
    assert not found[:9].any()
    np.testing.assert_array_equal(found[9:15, 14:21], valid[9:15, 14:21])


def test_an_image_without_a_gap_has_no_edge_and_one_without_a_surface_neither() -> None:
    assert not at_edge(np.ones((5, 5), bool), 4).any()
    assert not at_edge(np.zeros((5, 5), bool), 4).any()


@pytest.mark.parametrize("side", [1, 3, 7])
def test_squares_of_pixels_are_scipys(rng: np.random.Generator, side: int) -> None:
    mask = ndimage.binary_dilation(rng.random((40, 50)) > 0.97, iterations=2)
    np.testing.assert_array_equal(widened(mask, side), ndimage.maximum_filter(mask, side))
    np.testing.assert_array_equal(narrowed(mask, side), ndimage.minimum_filter(mask, side))
    ended = ndimage.minimum_filter(mask, side, mode="constant")
    np.testing.assert_array_equal(narrowed(mask, side, border_ends=True), ended)


def test_a_label_ends_where_another_one_is_near() -> None:
    labels = np.ones((20, 30), np.int32)
    labels[:, 12:] = 70_000
    labels[8:, 20:] = 0
    expected = ndimage.minimum_filter(labels, 5) == ndimage.maximum_filter(labels, 5)
    np.testing.assert_array_equal(of_one_label(labels, 5), expected)
    assert expected[0, 0]  # the border of the image is no end


def test_the_rim_of_a_label_is_two_pixels_wide_and_ends_at_what_has_none() -> None:
    labels = np.ones((20, 30), np.int32)
    labels[:, 12:] = 70_000
    labels[:, 20:24] = 0
    expected = np.zeros(labels.shape, bool)
    expected[:, 10:14] = True
    np.testing.assert_array_equal(beside_another_label(labels), expected)
    labels[:, 24:] = 2  # four pixels beyond: those of a gap between do not count
    np.testing.assert_array_equal(beside_another_label(labels), expected)
    assert not beside_another_label(np.zeros((0, 5), np.int32)).size


@pytest.mark.parametrize("width", [7, 8])
def test_gaps_are_told_where_they_are_and_narrow_ones_are_none(width: int) -> None:
    labels = np.ones((40, 60), np.int32)
    labels[10:19, 20:31] = 0
    labels[:, 40:46] = 0  # narrower than either
    labels[:9, :9] = 0  # the border of the image is no end
    labels[25, 12] = 0
    expected = labels == 0
    expected[:, 40:46] = expected[25, 12] = False
    np.testing.assert_array_equal(wide_gaps(labels, width), expected)
    np.testing.assert_array_equal(wide_gaps(labels[::-1, ::-1].copy(), width), expected[::-1, ::-1])


def test_distances_inside_are_exact(rng: np.random.Generator) -> None:
    mask = np.pad(rng.random((120, 150)) > 0.005, 1)
    expected = ndimage.distance_transform_edt(mask)
    # Roots of whole numbers, in single precision: at whole distances they are exact.
    np.testing.assert_array_equal(distance_inside(mask), expected.astype(np.float32))


@pytest.mark.parametrize("part", [np.s_[:40, 30:], np.s_[25:60, 10:90], np.s_[70:, :35], np.s_[:, 50:60]])
def test_distances_inside_a_part_of_an_image_are_exact(
    part: tuple[slice, slice], rng: np.random.Generator
) -> None:
    mask = np.zeros((90, 120), bool)
    mask[part] = rng.random(mask[part].shape) > 0.002
    expected = ndimage.distance_transform_edt(mask)
    np.testing.assert_array_equal(distance_inside(mask), expected.astype(np.float32))


def test_nothing_has_no_distances() -> None:
    np.testing.assert_array_equal(distance_inside(np.zeros((4, 5), bool)), np.zeros((4, 5)))


def test_a_box_holds_all_of_a_mask_and_no_more() -> None:
    mask = np.zeros((10, 12), bool)
    mask[3, 4] = mask[6, 2] = True
    assert box_of(mask) == (slice(3, 7), slice(2, 5))
    assert grown(box_of(mask), 3) == (slice(0, 10), slice(0, 8))
    assert mask[box_of(np.zeros_like(mask))].size == 0


def test_pixels_are_alone_that_reach_no_other_in_a_row_or_a_column() -> None:
    valid = np.ones((7, 9), bool)
    valid[:, [3, 5]] = False  # beside column 4
    one = np.zeros_like(valid)
    one[:, 4] = True
    np.testing.assert_array_equal(alone(valid), one)
    assert not alone(valid, 2).any()
    valid[:, [2, 6]] = False
    np.testing.assert_array_equal(alone(valid, 2), one)


def test_spots_are_pieces_no_wider_nor_higher_than_told() -> None:
    where = np.zeros((12, 20), bool)
    where[1:4, 1:4] = where[8, 2:8] = where[5:11, 12] = where[4, 16] = where[5, 17] = True
    small = np.zeros_like(where)
    small[1:4, 1:4] = small[4, 16] = small[5, 17] = True  # corners touch: one piece of two by two
    np.testing.assert_array_equal(spots(where, 5), small)
    assert not spots(np.ones((4, 4), bool), 3).any()
    assert not spots(np.zeros((4, 4), bool), 3).any()
