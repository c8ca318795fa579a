"""The closest point of a surface of triangles, and the signed distance to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface

_DEPTH = 64  # of the stack: more than any tree that fits into memory needs
_TOUCHING = 1e-9  # mm, below which the line to the closest point has no direction


@dataclass(frozen=True)
class Closest:
    """Of each point, what is closest to it on a surface.

    Attributes
    ----------
    distance
        (points,) in mm, positive outside; NaN where nothing is near enough.
    point
        (points, 3) in mm.
    direction
        (points, 3), of length 1: in which the distance grows.
    face
        (points,), the triangle; -1 where nothing is near enough.
    on_border
        (points,), whether the closest point is on the rim of the surface: the point is beside it.
    """

    distance: Floats
    point: Floats
    direction: Floats
    face: Ints
    on_border: Mask


@inner
@kernel
def _closest_on_triangle(p: Floats, t: Floats, q: Floats) -> int:
    """Write the point of triangle t (3, 3) closest to p into q (Ericson 2005, section 5.1.5).

    Returns where it is: 0 inside, 1 .. 3 on the edge behind corner 0 .. 2, 4 .. 6 at that corner.
    """
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = t[1, i] - t[0, i], t[2, i] - t[0, i]
        d1 += ab * (p[i] - t[0, i])
        d2 += ac * (p[i] - t[0, i])
        d3 += ab * (p[i] - t[1, i])
        d4 += ac * (p[i] - t[1, i])
        d5 += ab * (p[i] - t[2, i])
        d6 += ac * (p[i] - t[2, i])
    v = w = 0.0
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        feature = 4
    elif d3 >= 0.0 and d4 <= d3:
        feature, v = 5, 1.0
    elif d6 >= 0.0 and d5 <= d6:
        feature, w = 6, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        feature, v = 1, d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        feature, w = 3, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        feature, w = 2, (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        feature, v, w = 0, vb / (va + vb + vc), vc / (va + vb + vc)
    for i in range(3):
        q[i] = t[0, i] + v * (t[1, i] - t[0, i]) + w * (t[2, i] - t[0, i])
    return feature


@inner
@kernel
def _box_square(p: Floats, low: Floats, high: Floats) -> float:
    """Return the squared distance from p to a box."""
    square = 0.0
    for i in range(3):
        beyond = max(low[i] - p[i], p[i] - high[i], 0.0)
        square += beyond * beyond
    return square


@kernel
def _closest_rows(
    points: Floats,
    triangles: Floats,
    low: Floats,
    high: Floats,
    leaves: Ints,
    limit: float,
    start: int,
    stop: int,
    closest: Floats,
    face: Ints,
    feature: NDArray[np.int8],
) -> None:
    count, in_leaf = leaves.shape
    stack, q = np.empty(_DEPTH, np.int64), np.empty(3)
    for row in range(start, stop):
        p, best = points[row], limit * limit
        if not np.isfinite(p[0] + p[1] + p[2]):
            continue
        stack[0], size = 1, 1
        while size > 0:
            size -= 1
            node = stack[size]
            if _box_square(p, low[node], high[node]) >= best:
                continue
            if node < count:
                near, far = 2 * node, 2 * node + 1
                if _box_square(p, low[far], high[far]) < _box_square(p, low[near], high[near]):
                    near, far = far, near
                stack[size], stack[size + 1] = far, near
                size += 2
                continue
            for k in range(in_leaf):
                t = leaves[node - count, k]
                where = _closest_on_triangle(p, triangles[t], q)
                square = (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2
                if square < best:
                    best, face[row], feature[row] = square, t, where
                    closest[row] = q


def closest_points(
    surface: TriangleSurface, points: Floats, *, within_mm: float = np.inf, threads: int = 1
) -> Closest:
    """Find the closest point of a surface to each of the points (n, 3) in mm.

    Parameters
    ----------
    surface
        To be measured against.
    points
        (n, 3) in mm; NaN gives NaN.
    within_mm
        Points that are farther away than this have none.
    threads
        Number of threads; the result does not depend on it.
    """
    points = np.ascontiguousarray(points, np.float64)
    closest = np.full(points.shape, np.nan)
    face = np.full(len(points), -1, np.int64)
    feature = np.zeros(len(points), np.int8)
    tree = (surface.triangles, surface.low, surface.high, surface.leaves)

    def work(start: int, stop: int) -> None:
        _closest_rows(points, *tree, within_mm, start, stop, closest, face, feature)

    in_row_blocks(work, len(points), threads, block=4096)
    normal, border = _of_features(surface, face, feature)
    away = points - closest
    length = np.linalg.norm(away, axis=1)
    side = np.where(np.sum(away * normal, axis=1) < 0.0, -1.0, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = np.where((length > _TOUCHING)[:, None], side[:, None] * away / length[:, None], normal)
    direction[face < 0] = np.nan
    return Closest(side * length, closest, direction, face, border)


def _of_features(surface: TriangleSurface, face: Ints, feature: NDArray[np.int8]) -> tuple[Floats, Mask]:
    """Return the normal of the face, edge or corner that was found, and whether that lies on the rim."""
    some = np.maximum(face, 0)
    edge, corner = np.clip(feature - 1, 0, 2), np.clip(feature - 4, 0, 2)
    vertex = surface.faces[some, corner]
    on_edge, at_corner = (feature >= 1) & (feature <= 3), feature >= 4
    normal = np.where(on_edge[:, None], surface.edge_normals[some, edge], surface.face_normals[some])
    normal = np.where(at_corner[:, None], surface.vertex_normals[vertex], normal)
    border = (on_edge & surface.border_edges[some, edge]) | (at_corner & surface.border_vertices[vertex])
    return normal, border & (face >= 0)
