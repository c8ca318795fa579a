"""The rigid motion of a region is found with its deviation, and nothing of it is left."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.deformation.fields.rigid_motion import common_factor, rigid_motion
from sms_jobs.metrology.geometry.specimen_frame import tiles_of
from sms_jobs.metrology.geometry.transforms import rotation_matrix, rotation_vector

SIZE = 60
TURN_RAD, SHIFT_MM = np.array([0.002, -0.01, 0.03]), np.array([0.4, -0.2, 1.5])
ROWS, COLUMNS = (each.ravel() for each in np.mgrid[:SIZE, :SIZE])
TILES = tiles_of(ROWS, COLUMNS)


def moved(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a bent piece of surface of 30 mm, its rigid displacement with noise (3, n), and its middle."""
    x, y = 0.5 * COLUMNS - 15.0, 15.0 - 0.5 * ROWS
    points = np.stack([x, y, 900.0 - 0.01 * x**2], axis=1)
    middle = points.mean(axis=0)
    arm = points - middle
    return points, arm @ rotation_matrix(TURN_RAD).T - arm + SHIFT_MM + noise.T, middle


def test_what_is_rigid_leaves_nothing() -> None:
    points, displacement, middle = moved(np.zeros((3, SIZE * SIZE)))
    found = rigid_motion(points, displacement, np.full(len(points), 1e-4), TILES)
    # Roundings of positions of 900 mm.
    np.testing.assert_allclose(found.displacement(points.T).T, displacement, atol=1e-10)
    np.testing.assert_allclose(rotation_vector(found.rotation), TURN_RAD, atol=1e-11)
    np.testing.assert_allclose(found.middle, middle, atol=1e-10)
    np.testing.assert_allclose(found.shift, SHIFT_MM, atol=1e-10)


@pytest.mark.parametrize("together_px", [0.0, 1.5])
def test_the_deviation_of_a_motion_is_its_scatter(rng: np.random.Generator, together_px: float) -> None:
    off, stated = [], []
    for _ in range(150):
        noise = rng.normal(size=(3, SIZE, SIZE))
        if together_px:
            noise = ndimage.gaussian_filter(noise, (0.0, together_px, together_px))
        points, displacement, _ = moved(0.01 * noise.reshape(3, -1))
        found = rigid_motion(points, displacement, np.full(len(points), 1e-4), TILES)
        turn = rotation_vector(found.rotation @ rotation_matrix(TURN_RAD).T)
        off.append([*turn, *(found.shift - SHIFT_MM)])
        stated.append(np.diag(found.covariance))
    # The square of a scatter of 150 is known to 12 %, three of those. Noise that goes together over 5.3 px is
    # common to tiles of 15 px beside each other: 1.13 times the variance along each side, 1.27 in all.
    ratio = np.mean(np.square(off), axis=0) / np.mean(stated, axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=0.5)


def test_a_part_that_moves_otherwise_is_left_out(rng: np.random.Generator) -> None:
    points, displacement, _ = moved(0.01 * rng.normal(size=(3, SIZE * SIZE)))
    loose = (COLUMNS < 12) & (ROWS < 20)
    displacement[loose] += [0.0, 0.0, 0.7]
    found = rigid_motion(points, displacement, np.full(len(points), 1e-4), TILES)
    assert not found.used[loose].any()
    assert found.used[~loose].mean() > 0.99
    # Four deviations of the mean of 3000 points.
    assert np.abs(rotation_vector(found.rotation @ rotation_matrix(TURN_RAD).T)).max() < 2e-4


def test_what_is_left_far_away_is_as_uncertain_as_the_turn(rng: np.random.Generator) -> None:
    far = np.array([[300.0], [0.0], [900.0]])
    off, stated = [], []
    for _ in range(150):
        points, displacement, middle = moved(0.01 * rng.normal(size=(3, SIZE * SIZE)))
        found = rigid_motion(points, displacement, np.full(len(points), 1e-4), TILES)
        arm = far[:, 0] - middle
        true = rotation_matrix(TURN_RAD) @ arm - arm + SHIFT_MM
        off.append(found.displacement(far)[:, 0] - true)
        stated.append(found.covariance_at(far)[[0, 3, 5], 0])
    # As above.
    np.testing.assert_allclose(
        np.mean(np.square(off), axis=0)[1:] / np.mean(stated, axis=0)[1:], 1.0, atol=0.5
    )


def test_a_factor_moves_the_motion_as_it_moves_the_points(rng: np.random.Generator) -> None:
    points, displacement, _ = moved(np.zeros((3, SIZE * SIZE)))
    even = np.full(len(points), 1.0)
    before = rigid_motion(points, displacement, even, TILES)
    factor = rng.normal(size=(3, 4)) + np.einsum("ni,ijr->njr", 1e-2 * points, rng.normal(size=(3, 3, 4)))
    found, step = common_factor(before, points, factor), 1e-5
    for column in range(4):
        after = rigid_motion(points, displacement + step * factor[:, :, column], even, TILES)
        turn = rotation_vector(after.rotation @ before.rotation.T)
        # Second order in the step, and in the turn that is there already.
        np.testing.assert_allclose(
            [*turn / step, *(after.shift - before.shift) / step], found[:, column], atol=2e-2
        )


def test_a_region_that_tells_no_motion_is_refused() -> None:
    points, displacement, _ = moved(np.zeros((3, SIZE * SIZE)))
    even = np.ones(len(points))
    with pytest.raises(InvalidInput, match="are needed; choose a larger one"):
        rigid_motion(points[:50], displacement[:50], even[:50], TILES[:50])
    with pytest.raises(InvalidInput, match="in 1 of 16 parts"):
        rigid_motion(points, displacement, even, np.zeros_like(TILES))
    line = np.outer(np.linspace(0.0, 30.0, 200), [1.0, 0.2, 0.1])
    with pytest.raises(InvalidInput, match="is a line"):
        rigid_motion(line, np.zeros_like(line), np.ones(200), np.arange(200) // 20)
