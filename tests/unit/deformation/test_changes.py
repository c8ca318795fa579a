"""A field that was computed twice: how much it has changed, in numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sms_jobs.metrology.deformation.fields.changes import change_of, sigma_of_difference


def test_numbers_are_over_the_points_that_both_have() -> None:
    before = np.array([[1.0, 2.0, np.nan, 4.0]])
    after = np.array([[1.0, 1.0, 3.0, np.nan]])
    change, difference = change_of(before, after, np.full((1, 4), 0.4))
    assert (change.points, change.gained, change.lost) == (2, 1, 1)
    assert (change.rms, change.median, change.largest) == (math.sqrt(0.5), -0.5, 1.0)
    assert (change.sigma, change.beyond) == (pytest.approx(0.4), 0.5)
    np.testing.assert_array_equal(difference, [[0.0, -1.0, np.nan, np.nan]])


def test_nothing_is_said_of_what_is_not_known() -> None:
    nothing = np.full((2, 2), np.nan)
    change, _ = change_of(nothing, np.ones((2, 2)), None)
    assert (change.points, change.gained, change.rms, change.beyond) == (0, 4, None, None)
    change, _ = change_of(np.zeros((2, 2)), np.ones((2, 2)), None)
    assert (change.rms, change.sigma, change.beyond) == (1.0, None, None)
    change, _ = change_of(np.zeros((2, 2)), np.ones((2, 2)), nothing)
    assert (change.rms, change.sigma, change.beyond) == (1.0, None, None)


def test_a_change_without_any_stated_deviation_is_beyond_it() -> None:
    change, _ = change_of(np.zeros(3), np.array([0.0, 0.0, 1e-12]), np.zeros(3))
    assert change.beyond == pytest.approx(1 / 3)


def test_of_independent_noise_one_in_twenty_two_is_beyond(rng: np.random.Generator) -> None:
    count, spread = 200_000, (0.3, 0.4)
    before, after = (rng.normal(0.0, one, count) for one in spread)
    sigma = sigma_of_difference(*(np.full(count, one, np.float32) for one in spread))
    np.testing.assert_allclose(sigma, 0.5, rtol=1e-6)
    change, _ = change_of(before, after, sigma)
    expected = math.erfc(math.sqrt(2.0))
    assert change.beyond is not None
    # Five standard deviations of a count of so many.
    assert abs(change.beyond - expected) < 5.0 * math.sqrt(expected * (1.0 - expected) / count)
