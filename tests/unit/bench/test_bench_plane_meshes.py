"""Fields of flat meshes are those of their elements, also where sides are bent."""

from __future__ import annotations

import numpy as np

from sms_jobs.bench.two_cameras.plane_meshes import field_at


def two_elements() -> tuple[np.ndarray, np.ndarray]:
    """Return two squares side by side, their common side bent."""
    row, column = np.mgrid[0:3, 0:5]
    nodes = np.stack([column.ravel() * 0.5, row.ravel() * 0.5], axis=1).astype(float)
    nodes[7, 0] += 0.1  # the middle of the common side
    first = np.array([0, 2, 12, 10, 1, 7, 11, 5, 6])
    return nodes, np.stack([first, first + 2])


def test_linear_fields_are_exact_and_nothing_is_known_beside_the_mesh() -> None:
    nodes, elements = two_elements()
    field = nodes @ np.array([[2.0, -1.0], [0.5, 3.0]]) + 1.0
    points = np.random.default_rng(1).uniform(-0.2, 2.2, (500, 2))
    found = field_at(nodes, elements, field, points)
    inside = (points > 0.0).all(axis=1) & (points[:, 0] < 2.0) & (points[:, 1] < 1.0)
    np.testing.assert_array_equal(np.isfinite(found[:, 0]), inside)
    exact = points @ np.array([[2.0, -1.0], [0.5, 3.0]]) + 1.0
    np.testing.assert_allclose(found[inside], exact[inside], atol=1e-9)


def test_quadratic_fields_are_exact_in_straight_elements() -> None:
    nodes, elements = two_elements()
    nodes[7, 0] -= 0.1
    points = np.random.default_rng(2).uniform(0.01, 0.99, (200, 2)) * [2.0, 1.0]
    found = field_at(nodes, elements, (nodes**2)[:, :1] + nodes[:, 1:], points)
    np.testing.assert_allclose(found[:, 0], points[:, 0] ** 2 + points[:, 1], atol=1e-9)


def test_nodes_have_their_own_values() -> None:
    nodes, elements = two_elements()
    field = np.random.default_rng(3).normal(size=(len(nodes), 2))
    found = field_at(nodes, elements, field, nodes)
    np.testing.assert_allclose(found, field, atol=1e-9)
