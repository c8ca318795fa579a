"""The closest point of a surface is that of a search through all triangles; its side is told at edges too."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.surfaces.closest_points import closest_points
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface, triangle_surface


def slow_distance(point: np.ndarray, triangles: np.ndarray) -> float:
    """Return the distance to the nearest triangle: the least of those to its plane and its edges."""
    best = np.inf
    for a, b, c in triangles:
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        foot = point - (point - a) @ normal * normal
        inside = all(
            np.cross(end - start, foot - start) @ normal >= 0.0 for start, end in ((a, b), (b, c), (c, a))
        )
        if inside:
            best = min(best, abs((point - a) @ normal))
        for start, end in ((a, b), (b, c), (c, a)):
            along = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
            best = min(best, float(np.linalg.norm(point - start - along * (end - start))))
    return best


def soup(rng: np.random.Generator, count: int) -> TriangleSurface:
    corners = rng.normal(size=(count, 1, 3)) * 20.0 + rng.normal(size=(count, 3, 3)) * 4.0
    return triangle_surface(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def box() -> TriangleSurface:
    """A cube of side 2 about the origin, its corners listed once for each triangle, as in an STL file."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return triangle_surface(corners[np.array(faces).reshape(-1)], np.arange(36).reshape(-1, 3))


@pytest.mark.parametrize("count", [1, 3, 4, 5, 37, 200])
def test_the_tree_finds_what_a_search_through_all_triangles_finds(
    count: int, rng: np.random.Generator
) -> None:
    surface = soup(rng, count)
    points = rng.normal(size=(25, 3)) * 25.0
    found = closest_points(surface, points)
    expected = [slow_distance(p, surface.vertices[surface.faces]) for p in points]
    # Coordinates of up to 100 mm, some ten operations in double precision.
    np.testing.assert_allclose(np.abs(found.distance), expected, atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(points - found.point, axis=1), expected, atol=1e-11)


def test_the_distance_to_a_box_has_the_sign_of_the_side(rng: np.random.Generator) -> None:
    points = rng.uniform(-2.0, 2.0, (2000, 3))
    found = closest_points(box(), points)
    beyond = np.abs(points) - 1.0
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    expected = np.where(beyond.max(axis=1) <= 0.0, beyond.max(axis=1), outside)
    np.testing.assert_allclose(found.distance, expected, atol=1e-14)
    assert not found.on_border.any()  # a closed surface has no rim


def test_the_direction_is_the_gradient_of_the_distance(rng: np.random.Generator) -> None:
    points = rng.uniform(-2.0, 2.0, (200, 3))
    surface, step = box(), 1e-6
    found = closest_points(surface, points)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead = closest_points(surface, points + shift).distance
        back = closest_points(surface, points - shift).distance
        slope = (ahead - back) / (2.0 * step)
        # The distance is smooth but where two sides are equally far: a point in a hundred may be nearer to
        # that than the step; 1e-16 / 1e-6 of rounding elsewhere, and 1e-6 of curvature beside edges.
        assert np.quantile(np.abs(slope - found.direction[:, axis]), 0.98) < 1e-5


def test_corners_that_coincide_become_one() -> None:
    surface = box()
    assert surface.vertices.shape == (8, 3)
    assert not surface.border_edges.any()
    # By symmetry.
    np.testing.assert_allclose(surface.vertex_normals, surface.vertices / np.sqrt(3.0), atol=1e-15)


def test_points_beside_the_rim_are_told() -> None:
    square = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    surface = triangle_surface(square, np.array([[0, 1, 2], [0, 2, 3]]))
    points = np.array([[0.5, 0.4, 0.3], [0.5, 0.5, -0.3], [1.2, 0.5, 0.3], [1.2, 1.3, 0.1], [np.nan, 0, 0]])
    found = closest_points(surface, points)
    assert found.on_border.tolist() == [False, False, True, True, False]
    np.testing.assert_allclose(found.distance[:2], [0.3, -0.3], atol=1e-15)
    assert found.face[4] == -1
    assert np.isnan(found.distance[4])
    near = closest_points(surface, points, within_mm=0.3001)
    assert (near.face >= 0).tolist() == [True, True, False, False, False]


def test_threads_change_nothing(rng: np.random.Generator) -> None:
    surface, points = soup(rng, 300), rng.normal(size=(9000, 3)) * 25.0
    one, two = (closest_points(surface, points, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one.distance, two.distance)
    np.testing.assert_array_equal(one.face, two.face)


def test_a_surface_without_area_or_position_is_refused() -> None:
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    with pytest.raises(InvalidInput, match="no triangle with an area"):
        triangle_surface(line, np.array([[0, 1, 2]]))
    with pytest.raises(InvalidInput, match="no finite position"):
        triangle_surface(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
