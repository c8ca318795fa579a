"""Scores of the search along rays, wherever a square and its image lie."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.deformation.matching.epipolar_search import _score

HALF = 5
SLOPE = np.array([[1.1, 0.05], [-0.08, 0.93]])


@pytest.mark.parametrize(
    ("x", "y", "place"),
    [
        (20.3, 30.6, (40.2, 25.7)),
        (20.0, 30.0, (54.0, 25.0)),
        (3.2, 30.0, (40.0, 2.5)),
        (20.0, 36.4, (56.0, 31.5)),
    ],
    ids=["whole", "whole but for a column", "cut in both images", "cut in one"],
)
def test_a_score_is_the_correlation_of_what_both_images_show(
    rng: np.random.Generator, x: float, y: float, place: tuple[float, float]
) -> None:
    template, image = rng.random((42, 50)), rng.random((36, 60))
    column, row = np.meshgrid(np.arange(-HALF, HALF + 1) + round(x), np.arange(-HALF, HALF + 1) + round(y))
    known = (column >= 0) & (row >= 0) & (column < 50) & (row < 42)
    offset = np.stack([column - x, row - y])
    px, py = np.array(place)[:, None, None] + np.einsum("ij,jrc->irc", SLOPE, offset)
    seen = known & (px >= 0) & (py >= 0) & (px < 59) & (py < 35)
    assert seen.sum() > 0.6 * known.sum()  # of less no score is told
    g = ndimage.map_coordinates(image, [py[seen], px[seen]], order=1)
    expected = np.corrcoef(template[row[seen], column[seen]], g)[0, 1]
    found = _score(template, image, x, y, np.array(place), SLOPE, HALF)
    assert found == pytest.approx(expected, rel=1e-9)


def test_what_is_hardly_seen_has_no_score(rng: np.random.Generator) -> None:
    template, image = rng.random((42, 50)), rng.random((36, 60))
    assert _score(template, image, 20.0, 20.0, np.array([60.0, 20.0]), SLOPE, HALF) == -1.0
    assert _score(template, image, 20.0, 20.0, np.array([np.nan, 20.0]), SLOPE, HALF) == -1.0
