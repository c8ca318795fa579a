"""A surface of triangles, such as a CAD program writes it, made ready to be measured against.

Corners that coincide become one vertex, so that the surface has edges that two triangles share and edges of
its own. A tree of boxes finds the triangle that is closest to a point: a complete binary tree, halved at
the median of the longest side of each box, in the order of a heap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints, Mask

_IN_LEAF = 4


@dataclass(frozen=True)
class TriangleSurface:
    """Triangles with their neighbourhood and a tree of boxes around them.

    Attributes
    ----------
    vertices, faces
        (vertices, 3) in mm and (faces, 3): corners counter-clockwise seen from outside.
    triangles
        (faces, 3, 3) in mm: the positions of the corners of each.
    face_normals, edge_normals, vertex_normals
        (faces, 3), (faces, 3, 3) and (vertices, 3), of length 1: of an edge the mean of its triangles', of a
        vertex the mean weighted by the angles there. Edge k of a triangle runs from its corner k to the next.
    border_edges, border_vertices
        (faces, 3) and (vertices,): what lies on the rim of the surface.
    low, high
        (2 leaves, 3): boxes of the tree's nodes; node 1 is the root, 2 n and 2 n + 1 are in n.
    leaves
        (leaves, triangles of a leaf): the triangles in the nodes from `len(leaves)` on.
    """

    vertices: Floats
    faces: Ints
    triangles: Floats
    face_normals: Floats
    edge_normals: Floats
    vertex_normals: Floats
    border_edges: Mask
    border_vertices: Mask
    low: Floats
    high: Floats
    leaves: Ints

    def area(self) -> Floats:
        """Return the area of each triangle in mm^2, (faces,)."""
        a, b, c = (self.triangles[:, k] for k in range(3))
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def triangle_surface(vertices: Floats, faces: NDArray[np.integer]) -> TriangleSurface:
    """Prepare triangles to be measured against.

    Parameters
    ----------
    vertices
        (n, 3) in mm; the same position may occur several times, as in an STL file.
    faces
        (m, 3), indices of corners, counter-clockwise seen from outside.

    Raises
    ------
    InvalidInput
        A position is not finite, or no triangle has an area.

    Notes
    -----
    Triangles without area are left out. Normals of edges and vertices are those of Bærentzen and Aanæs 2005,
    which give the side of a surface on which a point lies even at edges and corners.
    """
    if not np.isfinite(vertices).all():
        raise InvalidInput("a vertex of the reference surface has no finite position; correct the file")
    joined, number = np.unique(np.asarray(vertices, np.float64) + 0.0, axis=0, return_inverse=True)
    corners = number.reshape(-1)[np.asarray(faces, np.int64)].reshape(-1, 3)
    a, b, c = (joined[corners[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    longest = np.max([np.linalg.norm(d, axis=1) for d in (b - a, c - b, a - c)], axis=0, initial=0.0)
    # A sliver lower than a millionth of its length has no normal to speak of.
    kept = doubled > 1e-6 * longest**2
    if not kept.any():
        raise InvalidInput("the reference surface has no triangle with an area; correct the file")
    corners, normals = corners[kept], normals[kept] / doubled[kept, None]
    edge_normals, border_edges = _edges(corners, normals)
    border = np.zeros(len(joined), np.bool_)
    for k in range(3):
        border[corners[border_edges[:, k], k]] = True
        border[corners[border_edges[:, k], (k + 1) % 3]] = True
    triangles = joined[corners]
    low, high, leaves = _tree(triangles)
    return TriangleSurface(
        joined,
        corners,
        triangles,
        normals,
        edge_normals,
        _vertex_normals(joined, corners, normals),
        border_edges,
        border,
        low,
        high,
        leaves,
    )


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0))


def _edges(corners: Ints, normals: Floats) -> tuple[Floats, Mask]:
    """Return the normal of each edge of each triangle, and whether no other triangle has that edge."""
    ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends.sort(axis=1)
    key = ends[:, 0] * (corners.max() + 1) + ends[:, 1]
    _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, edge, np.repeat(normals, 3, axis=0))
    return _unit(total)[edge].reshape(-1, 3, 3), (count[edge] == 1).reshape(-1, 3)


def _vertex_normals(vertices: Floats, corners: Ints, normals: Floats) -> Floats:
    total = np.zeros_like(vertices)
    for k in range(3):
        here = vertices[corners[:, k]]
        ahead = _unit(vertices[corners[:, (k + 1) % 3]] - here)
        back = _unit(vertices[corners[:, (k + 2) % 3]] - here)
        angle = np.arccos(np.clip(np.sum(ahead * back, axis=1), -1.0, 1.0))
        np.add.at(total, corners[:, k], angle[:, None] * normals)
    return _unit(total)


def _tree(triangles: Floats) -> tuple[Floats, Floats, Ints]:
    """Return boxes in the order of a heap and the triangles of each leaf; a leaf may name one twice."""
    count = len(triangles)
    leaves = 1
    while leaves * _IN_LEAF < count:
        leaves *= 2
    in_leaf = -(-count // leaves)
    order = np.zeros(leaves * in_leaf, np.int64)
    order[:count] = np.arange(count)
    middles = triangles.mean(axis=1)
    parts = 1
    while parts < leaves:
        some = order.reshape(parts, -1)
        places = middles[some]
        axis = np.argmax(np.ptp(places, axis=1), axis=1)
        keys = np.take_along_axis(places, axis[:, None, None], axis=2)[:, :, 0]
        split = np.argpartition(keys, some.shape[1] // 2, axis=1)
        order = np.take_along_axis(some, split, axis=1).reshape(-1)
        parts *= 2
    grouped = order.reshape(leaves, in_leaf)
    low, high = np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)
    low[leaves:] = triangles.min(axis=1)[grouped].min(axis=1)
    high[leaves:] = triangles.max(axis=1)[grouped].max(axis=1)
    for first in (2**k for k in reversed(range(leaves.bit_length() - 1))):
        inside = slice(2 * first, 4 * first)
        low[first : 2 * first] = low[inside].reshape(first, 2, 3).min(axis=1)
        high[first : 2 * first] = high[inside].reshape(first, 2, 3).max(axis=1)
    return low, high, grouped
