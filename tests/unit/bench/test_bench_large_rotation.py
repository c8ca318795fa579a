"""A disc that turns: the study's images are exact, and following reaches what a direct match does not."""

from __future__ import annotations

import numpy as np

from sms_jobs.bench.correlated.speckle_pairs import affine_speckle
from sms_jobs.bench.studies.large_rotation import series


def test_a_quarter_turn_is_the_same_image_turned() -> None:
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    still, turned = (affine_speckle(64, forward, 5) for forward in (np.eye(2), quarter))
    # x goes to y and y to -x: rows of the one are columns of the other. Blobs are cut off at exp(-18).
    np.testing.assert_allclose(turned, still.T[:, ::-1], atol=1e-3)
    assert 200.0 < still.std() < 800.0


def test_following_holds_where_the_reference_is_lost() -> None:
    found = series(lambda text: None, size=160, states=5, radius=12)
    assert found["first"][-1].matched < 0.1
    assert found["auto"][-1].matched > 0.95
    assert found["previous"][-1].matched > 0.95
    # Matched with the reference itself: the error of a single match. Some 90 points that overlap: 15 %.
    assert 0.75 < found["auto"][-1].rms / found["auto"][-1].stated < 1.35
    # Added up: more, and so is what is stated.
    assert found["auto"][-1].rms < found["previous"][-1].rms
    assert 0.7 < found["previous"][-1].rms / found["previous"][-1].stated < 1.4
