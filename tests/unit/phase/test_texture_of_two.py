"""The spots of two cameras are told by the gaps that a texture opens, as far as points depend on them."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.phase.texture_of_two import UNKNOWN_SPOTS, Spots, estimate_spots

COUNT = 20_000


@pytest.mark.parametrize("alike", [0.0, 0.95])
def test_both_spots_are_found_and_stated(rng: np.random.Generator, alike: float) -> None:
    # The gaps of one camera are as those of the other but for a part: what differs tells the spots apart.
    true, noise = np.array([0.35, 0.55]), 0.02
    one, own = rng.normal(size=(2, COUNT)) * 0.1
    change = np.stack([one, -alike * one + np.sqrt(1.0 - alike**2) * own])
    gap = -true @ change + noise * rng.normal(size=COUNT)
    found = estimate_spots(gap, np.full(COUNT, noise), change, np.full(COUNT, 1e-9))
    off = found.variance - true
    # A chi-square of two is below 18.4 for all but one of ten thousand.
    assert float(off @ np.linalg.solve(found.covariance, off)) < 18.4
    shifts = rng.normal(size=(2, 1, 100))
    left = found.left(
        (shifts[0], shifts[1]), (np.zeros((1, 100), np.float32), np.zeros((1, 100), np.float32))
    )
    told = np.array([np.sqrt(np.array([a, -b]) @ found.covariance @ [a, -b]) for a, b in shifts[:, 0].T])
    np.testing.assert_allclose(left[0], told, rtol=1e-5)


def test_without_a_texture_nothing_is_known_but_what_was_before() -> None:
    nothing = np.zeros(100)
    found = estimate_spots(nothing, np.full(100, 0.01), np.zeros((2, 100)), nothing)
    np.testing.assert_allclose(found.variance, UNKNOWN_SPOTS.variance)
    np.testing.assert_allclose(found.covariance, UNKNOWN_SPOTS.covariance)
    assert found.rough_px == pytest.approx(UNKNOWN_SPOTS.rough_px)


def test_what_pixels_hide_is_found_beside_known_spots(rng: np.random.Generator) -> None:
    change, rough = rng.normal(size=(2, COUNT)), rng.uniform(0.0, 1.0, COUNT)
    gap = -np.array([0.25, 0.25]) @ change + np.hypot(0.02, 0.06 * rough) * rng.normal(size=COUNT)
    found = estimate_spots(gap, np.full(COUNT, 0.02), change, rough, known_px=0.5)
    assert found.variance.tolist() == [0.25, 0.25]
    assert not found.covariance.any()
    # Squares of 20,000 values of which the roughest count: known to a few per cent.
    assert found.rough_px == pytest.approx(0.06, rel=0.1)


def test_the_mean_of_both_spots_is_as_uncertain_as_both_say() -> None:
    spots = Spots(np.array([0.2, 0.4]), np.array([[0.04, -0.03], [-0.03, 0.04]]), 0.1)
    assert spots.mean.variance == pytest.approx(0.3)
    assert spots.mean.variance_sigma == pytest.approx(np.sqrt(0.25 * (0.04 + 0.04 - 0.06)))
    assert spots.largest(1) == pytest.approx(0.6)
