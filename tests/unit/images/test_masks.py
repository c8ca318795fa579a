"""Masks keep the good pixels that they say they keep."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.images.masks import (
    at_edge,
    high_phase_error,
    large_ray_gap,
    low_modulation,
    outside_box,
    phase_error_factor,
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


def test_an_image_without_a_gap_has_no_edge_and_one_without_a_surface_neither() -> None:
    assert not at_edge(np.ones((5, 5), bool), 4).any()
    assert not at_edge(np.zeros((5, 5), bool), 4).any()
