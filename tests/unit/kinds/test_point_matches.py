"""Which pixels are told by matches: those between them, and few beyond the outermost."""

from __future__ import annotations

import numpy as np

from sms_jobs.kinds.point_matches import between_matches
from sms_jobs.metrology.deformation.matching.correlation import CONVERGED, blank_matches
from sms_jobs.metrology.deformation.matching.grid import GridMatches

SPACING = 5
SHAPE = (60, 60)


def grid(low: int, high: int, lost: tuple[tuple[int, int], ...] = (), spacing: int = SPACING) -> GridMatches:
    """Return matched points of a square grid, but for some (x, y) that were lost."""
    y, x = np.mgrid[low : high + 1 : spacing, low : high + 1 : spacing].reshape(2, -1)
    matches = blank_matches(len(x), 6)
    matches.ending[:] = CONVERGED
    for at in lost:
        matches.ending[(x == at[0]) & (y == at[1])] += 1
    return GridMatches(x, y, matches)


def test_two_pixels_beyond_the_outermost_points_are_told_and_never_one_nearer_to_another_point() -> None:
    for spacing, beyond in ((5, 2), (10, 2), (2, 1), (1, 0)):
        told = between_matches(grid(22, 42, spacing=spacing), SHAPE, spacing)
        wanted = np.zeros(SHAPE, dtype=bool)
        wanted[22 - beyond : 43 + beyond, 22 - beyond : 43 + beyond] = True
        np.testing.assert_array_equal(told, wanted, err_msg=f"spacing {spacing}")


def test_near_the_image_s_border_nothing_is_told() -> None:
    told = between_matches(grid(2, 57), SHAPE, SPACING)
    wanted = np.zeros(SHAPE, dtype=bool)
    wanted[SPACING:-SPACING, SPACING:-SPACING] = True
    np.testing.assert_array_equal(told, wanted)


def test_about_an_outermost_point_that_failed_it_ends_at_the_points_beside_it() -> None:
    told = between_matches(grid(22, 42, lost=((42, 32),)), SHAPE, SPACING)
    # Neither between it and the next one, nor beyond that row, as far as its neighbours.
    assert told[32, 37]
    assert not told[27:38, 43:].any()
    assert not told[30:35, 40:].any()
    assert told[26, 44]
    # A whole row of them is the same as no row, but that nothing is told beyond the next.
    row = tuple((42, y) for y in range(22, 43, SPACING))
    told = between_matches(grid(22, 42, lost=row), SHAPE, SPACING)
    wanted = np.zeros(SHAPE, dtype=bool)
    wanted[20:45, 20:37] = True
    wanted[22:43, 37] = True
    np.testing.assert_array_equal(told, wanted)
