"""Fields compared with one another."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.deformation.fields.comparison import free_of_motion, laid_on, values_at


def test_a_linear_field_is_found_between_the_nodes_of_another(rng: np.random.Generator) -> None:
    nodes = rng.uniform(-20.0, 20.0, (400, 2))
    at = rng.uniform(-18.0, 18.0, (300, 2))
    nodes, at = (np.column_stack([p, 0.3 * p[:, 0] - 0.2 * p[:, 1]]) for p in (nodes, at))
    gradient = rng.normal(size=(3, 2))
    values = nodes @ gradient + 1.0
    values[::50] = np.nan
    found = values_at(nodes, values, at, within_mm=10.0)
    # On a plane a linear field is its own local plane, but for the least weight of a node that is hit.
    np.testing.assert_allclose(found, at @ gradient + 1.0, atol=1e-9)


def test_what_is_far_from_the_other_field_has_no_value() -> None:
    nodes = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [2.0, 1.0, 0.0]])
    found = values_at(nodes, np.ones((5, 1)), np.array([[0.5, 0.5, 0.0], [9.0, 0.0, 0.0]]), within_mm=2.0)
    assert found[0, 0] == pytest.approx(1.0)
    assert np.isnan(found[1, 0])
    assert np.isnan(values_at(nodes[:3], np.ones((3, 1)), nodes, within_mm=2.0)).all()


def test_a_moved_surface_is_laid_back(rng: np.random.Generator) -> None:
    x, y = rng.uniform(-50.0, 50.0, (2, 4000))
    surface = np.column_stack([x, y, 12.0 * np.sin(x / 17.0) + 8.0 * np.cos(y / 11.0)])
    turn = Rotation.from_rotvec([0.01, -0.015, 0.02]).as_matrix()
    moved = surface[:1500] @ turn.T + [0.5, -0.4, 0.3]
    pose, rms = laid_on(moved, surface)
    # Its points are among those of the target: nothing is left once each has found its own.
    back = moved @ pose.matrix().T + np.array(pose.translation)
    assert rms < 0.05
    np.testing.assert_allclose(back, surface[:1500], atol=0.1)


def test_a_rigid_motion_is_no_difference(rng: np.random.Generator) -> None:
    points = rng.uniform(-50.0, 50.0, (200, 3))
    turn = Rotation.from_rotvec([1e-3, -2e-3, 3e-3]).as_matrix()
    difference = points @ turn.T + [0.3, 0.1, -0.2] - points
    assert np.abs(free_of_motion(points, difference)).max() < 1e-12
    bent = difference + np.column_stack([0 * points[:, :2], 1e-4 * points[:, 0] ** 2])
    assert np.abs(free_of_motion(points, bent)).max() > 0.05
