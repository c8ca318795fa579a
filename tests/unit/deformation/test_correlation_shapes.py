"""Shape functions compose, stay in the image and are carried from point to point as their equations say."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.deformation.matching.shape_functions import (
    carried,
    compose_inverse,
    inside,
    places,
    warped,
)
from sms_jobs.metrology.images.spline import PADDING

AFFINE = (0.3, 0.02, -0.01, -0.4, 0.015, 0.03)
BENT = (*AFFINE, 1e-3, -5e-4, 7e-4, 6e-4, -8e-4, 1.2e-3)
STEP = (-0.2, 0.01, 0.02, 0.1, -0.01, 0.02, 8e-4, 5e-4, -6e-4, -7e-4, 4e-4, 9e-4)


def goes_to(p: np.ndarray, at: np.ndarray) -> np.ndarray:
    return at + np.array(warped(p, *at))


def comes_from(p: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Invert a warp by iteration, which contracts by its slope of 0.05."""
    at = to.copy()
    for _ in range(60):
        at = to - np.array(warped(p, *at))
    return at


@pytest.mark.parametrize("length", [6, 12])
def test_composition_keeps_value_slope_and_curvature_at_the_centre(length: int) -> None:
    p, step = (np.array([*numbers[:length], *(0.0,) * (12 - length)]) for numbers in (BENT, STEP))

    def both(x: float, y: float) -> np.ndarray:
        to = np.array([x, y])
        return goes_to(p, comes_from(step, to)) - to

    found = p.copy()
    compose_inverse(found, step)
    h = 0.1
    e = {k: both(h * k[0], h * k[1]) for k in [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]}
    slope_x, slope_y = (e[1, 0] - e[-1, 0]) / (2 * h), (e[0, 1] - e[0, -1]) / (2 * h)
    bend_x, bend_y = ((e[k] + e[-k[0], -k[1]] - 2 * e[0, 0]) / h**2 for k in ((1, 0), (0, 1)))
    mixed = (e[1, 1] + e[-1, -1] - e[1, -1] - e[-1, 1]) / (4 * h**2)
    for i in (0, 1):
        expected = [e[0, 0][i], slope_x[i], slope_y[i]]
        # h^2 / 6 of a third derivative, that of two curvatures of 10^-3, 3 x 10^-6.
        np.testing.assert_allclose(found[3 * i : 3 * i + 3], expected, atol=1e-8)
        np.testing.assert_allclose(found[6 + 3 * i : 9 + 3 * i], [bend_x[i], mixed[i], bend_y[i]], atol=1e-8)


def test_affine_composition_is_the_product_of_matrices() -> None:
    def matrix(p: np.ndarray) -> np.ndarray:
        return np.array([[1 + p[1], p[2], p[0]], [p[4], 1 + p[5], p[3]], [0, 0, 1]])

    p, step = (np.array([*numbers[:6], *(0.0,) * 6]) for numbers in (BENT, STEP))
    expected = matrix(p) @ np.linalg.inv(matrix(step))
    compose_inverse(p, step)
    np.testing.assert_allclose(matrix(p), expected, atol=1e-14)  # rounding
    assert not p[6:].any()


def test_a_warp_is_the_same_map_from_any_point(rng: np.random.Generator) -> None:
    p, away = np.array(BENT), np.array([7.0, -4.0])
    moved = carried(p, *away)
    for at in rng.uniform(-10.0, 10.0, (5, 2)):
        np.testing.assert_allclose(warped(moved, *at), warped(p, *(away + at)), atol=1e-13)  # rounding
    np.testing.assert_array_equal(carried(np.array(AFFINE), 0.0, 0.0), AFFINE)
    np.testing.assert_allclose(carried(np.array(AFFINE), *away)[0], 0.3 + 7.0 * 0.02 + 4.0 * 0.01)


def test_pixels_go_where_the_warp_says_and_a_box_inside_has_all_of_them_inside(
    rng: np.random.Generator,
) -> None:
    y, x = (v.ravel().astype(np.float64) for v in np.mgrid[-6:7, -9:4])
    n, columns = len(x), 60 + 2 * PADDING
    first, s, t = np.empty(n, np.int64), np.empty(n), np.empty(n)
    let_in = 0
    for _ in range(300):
        p = rng.normal(size=12) * np.repeat([8.0, 0.3, 0.3, 8.0, 0.3, 0.3, 0.03], [1, 1, 1, 1, 1, 1, 6])
        u, v = (np.array(w) for w in zip(*(warped(p, *at) for at in zip(x, y, strict=True)), strict=True))
        px, py = 20 + x + u, 15 + y + v
        if inside(p, 20, 15, -9, 3, -6, 6, 40, 60, 2.0):
            let_in += 1
            assert min(px.min(), py.min()) >= -2.0
            assert px.max() <= 61.0
            assert py.max() <= 41.0
            places(p, 2, 20, 15, columns, n, x, y, first, s, t)
            row, column = np.divmod(first, columns)
            np.testing.assert_allclose(column + 2 - PADDING + s, px, atol=1e-12)
            np.testing.assert_allclose(row + 2 - PADDING + t, py, atol=1e-12)
    assert let_in > 30
    assert not inside(np.full(12, np.nan), 20, 15, -9, 3, -6, 6, 40, 60, 2.0)
