"""Small symmetric systems are solved as LAPACK solves them."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.small_systems import back_substitute, factorise, inverse, solve

CONDITION = 1e6  # of the systems once their diagonal is 1
# Of Cholesky's method, and of what it is compared with, each a few times condition and rounding.
ROUNDING = 10.0 * CONDITION * np.finfo(float).eps


def a_system(unknowns: int, seed: int) -> tuple[Floats, Floats]:
    """Return a positive definite matrix, whose unknowns have units of 1e-6 to 1e6, and a right side."""
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.normal(size=(unknowns, unknowns)))[0]
    units = 10.0 ** random.uniform(-6.0, 6.0, unknowns)
    matrix = turn @ np.diag(np.geomspace(1.0 / CONDITION, 1.0, unknowns)) @ turn.T
    return 0.5 * (matrix + matrix.T) * np.outer(units, units), units * random.normal(size=unknowns)


@pytest.mark.parametrize("unknowns", [1, 2, 9, 12, 210])
def test_solutions_and_inverses_are_those_of_lapack(unknowns: int) -> None:
    matrix, vector = a_system(unknowns, unknowns)
    units = np.sqrt(np.diag(matrix))
    scaled = matrix / np.outer(units, units)
    exact = np.linalg.inv(scaled)
    found = inverse(matrix)
    assert found is not None
    assert np.linalg.norm(found * np.outer(units, units) - exact) <= ROUNDING * np.linalg.norm(exact)
    expected = exact @ (vector / units)
    error = np.linalg.norm(units * solve(matrix, vector, 0.0) - expected)
    assert error <= ROUNDING * np.linalg.norm(expected)


def test_only_the_lower_triangle_is_read_and_replaced() -> None:
    matrix, vector = a_system(5, 3)
    expected, units = np.linalg.solve(matrix, vector), np.sqrt(np.diag(matrix))
    above = np.triu_indices(5, 1)
    matrix[above] = np.nan
    assert factorise(matrix)
    back_substitute(matrix, vector)
    assert np.linalg.norm(units * (vector - expected)) <= ROUNDING * np.linalg.norm(units * expected)
    assert np.isnan(matrix[above]).all()


@pytest.mark.parametrize(
    "matrix", [np.diag([1.0, 0.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.diag([1.0, np.nan])]
)
def test_what_is_not_positive_definite_has_no_factor(matrix: Floats) -> None:
    assert inverse(matrix) is None
    assert not factorise(matrix.copy())


def test_a_system_that_is_singular_is_damped() -> None:
    found = solve(np.array([[1.0, 1.0], [1.0, 1.0]]), np.array([2.0, 2.0]), 0.0)
    np.testing.assert_allclose(found, [1.0, 1.0], rtol=1e-10)
