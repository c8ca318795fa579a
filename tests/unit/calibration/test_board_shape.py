"""Bow and twist of a board: what one millimetre of each means, and that none of them moves its plane."""

import numpy as np
import pytest

from sms_jobs.metrology.calibration.board_shape import shape_terms
from sms_jobs.metrology.calibration.estimates import SHAPE, Estimated

_OUTLINE = ((-30.0, 90.0), (10.0, 50.0))


def _grid(columns, rows):
    x, y = np.meshgrid(np.linspace(*_OUTLINE[0], columns), np.linspace(*_OUTLINE[1], rows))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def test_a_bow_is_how_far_the_ends_of_a_middle_line_lie_above_its_middle():
    middle, side, front, corner = shape_terms(np.array([[30, 30], [90, 30], [30, 10], [90, 50]]), _OUTLINE)
    assert side - middle == pytest.approx([1.0, 0.0, 0.0])
    assert front - middle == pytest.approx([0.0, 1.0, 0.0])
    assert corner[SHAPE.index(Estimated.TWIST)] == pytest.approx(1.0)


def test_no_term_moves_or_tilts_the_plane_that_fits_best():
    points = _grid(200, 150)
    terms = shape_terms(points, _OUTLINE)
    centred = (points - points.mean(axis=0)) / np.ptp(points, axis=0)
    plane, *_ = np.linalg.lstsq(np.column_stack([np.ones(len(points)), centred]), terms, rcond=None)
    # The mean of u^2 over n places from -1 to 1, both ends among them, is 1/3 + 2 / (3 (n - 1)).
    assert np.abs(plane).max() == pytest.approx(2.0 / (3.0 * 149), rel=1e-6)
