"""Speckle views are exact, and the figures of the group `dic` are what they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.bench.correlated.speckle_pairs import halves, quadratic, shift, speckle_pair
from sms_jobs.bench.groups.dic import Points, errors, labelled, places

SIZE = 96


def test_a_whole_pixel_shift_is_the_same_image_moved() -> None:
    reference, deformed = speckle_pair(SIZE, shift(3.0, -2.0), 1)
    # Blobs are cut off at exp(-18), 10^-8 of a contrast of 400.
    np.testing.assert_allclose(deformed[8:-8, 11:-5], reference[10:-6, 8:-8], atol=1e-3)
    assert reference.std() == pytest.approx(400.0)


def test_sub_pixel_shifts_are_those_of_the_spline() -> None:
    reference, deformed = speckle_pair(SIZE, shift(0.3, -0.6), 2)
    row, column = np.mgrid[10 : SIZE - 10, 10 : SIZE - 10].astype(float)
    expected = ndimage.map_coordinates(reference, [row + 0.6, column - 0.3], order=5, mode="mirror")
    # The quintic's error for blobs of 1.8 px: 10^-3 px of slopes near 200 grey levels a pixel.
    np.testing.assert_allclose(deformed[10:-10, 10:-10], expected, atol=0.2)


def test_errors_are_those_of_the_field() -> None:
    field = quadratic(SIZE, 3e-4)
    x, y = places(SIZE, 30, 12)
    truth = np.stack(field(x.astype(float), y.astype(float)), axis=1)
    images = labelled(*speckle_pair(SIZE, field, 3))
    points = Points(x, y, truth)
    second, sigma = errors(images, points, 2)
    first, _ = errors(images, points, 1)
    assert len(second) == len(x) == len(sigma)
    # The spline of blobs 1.8 px wide is off by less than 10^-3 px.
    assert np.abs(second).max() < 1e-3
    # Mean of (a^2 + b^2) / 2 over a square of radius 16: 16 x 17 / 3 = 91 px^2; 3 x 10^-4 of it is 0.027 px,
    # and that is what a first-order subset adds on the average.
    assert first.mean() == pytest.approx(0.027, rel=0.2)


def test_halves_meet_at_the_edge_of_their_labels() -> None:
    reference, deformed, labels = halves(SIZE, 1.0, 2.0, 4)
    assert (labels[: SIZE // 2] == 1).all()
    assert (labels[SIZE // 2 :] == 2).all()
    np.testing.assert_allclose(deformed[:48, 9:-9], reference[:48, 8:-10], atol=1e-3)
    np.testing.assert_allclose(deformed[48:, 10:-8], reference[48:, 8:-10], atol=1e-3)
