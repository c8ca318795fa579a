"""Displacements of several programs are compared at the same points."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.bench.two_cameras.compared_programs import at_points, differences_um, given_gt4
from sms_jobs.bench.two_cameras.peers import Outcome
from sms_jobs.bench.two_cameras.published import FOLDER, published
from sms_jobs.metrology.arrays import Floats

STATES = 2


def moved(x: Floats, y: Floats) -> Floats:
    """Return a displacement (states, 3, n) that is linear in each direction, in mm."""
    first = np.stack([1e-3 * x, 2e-3 * y, 1e-5 * x * y])
    return np.stack([first, 2.0 * first])


def on_grid(low: int, high: int, spacing: int) -> Outcome:
    y, x = np.mgrid[low:high:spacing, low:high:spacing].reshape(2, -1).astype(float)
    return Outcome(np.stack([x, y]), moved(x, y), 1.0, spacing)


def test_between_the_points_of_a_grid_is_what_is_linear_between_them() -> None:
    found = on_grid(4, 40, 8)
    at = np.array([[4.0, 36.0, 13.0, 3.0, 40.0], [4.0, 36.0, 19.0, 20.0, 20.0]])
    value = at_points(found, at)
    np.testing.assert_allclose(value[:, :, :3], moved(*at[:, :3]), atol=1e-15)
    # Beside the grid there is nothing.
    assert np.isnan(value[:, :, 3:]).all()


def test_a_point_that_is_missing_is_missing_to_its_neighbours_but_not_to_points_of_the_grid() -> None:
    found = on_grid(4, 40, 8)
    lost = (found.pixels[0] == 12) & (found.pixels[1] == 12)
    found.displacement[:, :, lost] = np.nan
    value = at_points(found, np.array([[12.0, 20.0, 13.0], [12.0, 12.0, 13.0]]))
    assert np.isnan(value[:, :, [0, 2]]).all()
    np.testing.assert_allclose(value[:, :, 1], moved(np.array([20.0]), np.array([12.0]))[:, :, 0])


def test_each_two_programs_are_compared_in_um() -> None:
    y, x = np.mgrid[0:48, 0:48].astype(float)
    here = moved(x.ravel(), y.ravel()).reshape(STATES, 3, 48, 48)
    coarse, fine = on_grid(4, 40, 8), on_grid(6, 30, 4)
    fine.displacement[1, 2] += 5e-3
    found = differences_um(here, {"coarse": coarse, "fine": fine})
    assert list(found) == [("here", "coarse"), ("here", "fine"), ("coarse", "fine")]
    np.testing.assert_allclose(found["here", "coarse"], 0.0, atol=1e-12)
    for pair in (("here", "fine"), ("coarse", "fine")):
        np.testing.assert_allclose(found[pair][1, 2], -5.0)
        np.testing.assert_allclose(found[pair][0], 0.0, atol=1e-12)


def test_what_programs_are_given_of_gt4_is_its_specimen() -> None:
    if not published():
        pytest.skip(f"{FOLDER.name} is not there: put the published images into {FOLDER}")
    given = given_gt4()
    assert len(given.images) == 6
    assert given.specimen.shape == given.images[0][0].shape
    # The middle of the sheet, and the opening above it.
    assert given.specimen[700, 960]
    assert not given.specimen[260, 900]
    assert 0.45 < given.specimen.mean() < 0.55
