"""Exact fields of flat meshes of nine-node quadrilaterals, at any point of their plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sms_jobs.metrology.arrays import Floats

_NEAREST = 12  # elements that are tried for a point
_STEPS = 12  # of Newton, from an element's middle
_INSIDE = 1.0 + 1e-9
_AT = ((-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0), (0, 0))
"""Places of the nodes in an element's own coordinates: corners, sides, middle."""


def _along(at: int, s: Floats) -> tuple[Floats, Floats]:
    """Return a quadratic that is 1 at one of -1, 0 and 1 and 0 at the others, and its slope."""
    if at == 0:
        return 1.0 - s * s, -2.0 * s
    return 0.5 * s * (s + at), s + 0.5 * at


def _shapes(s: Floats, t: Floats) -> tuple[Floats, Floats]:
    """Return the functions of the nine nodes (n, 9) and their slopes (n, 9, 2)."""
    values, slopes = np.empty((len(s), 9)), np.empty((len(s), 9, 2))
    for node, (i, j) in enumerate(_AT):
        (a, da), (b, db) = _along(i, s), _along(j, t)
        values[:, node] = a * b
        slopes[:, node] = np.stack([da * b, a * db], axis=1)
    return values, slopes


def field_at(nodes: Floats, elements: NDArray[np.integer], field: Floats, points: Floats) -> Floats:
    """Return a field of the nodes at some points, (n, components); NaN beside the mesh.

    Parameters
    ----------
    nodes
        (nodes, 2), places.
    elements
        (elements, 9), nodes of each: corners, sides, middle.
    field
        (nodes, components).
    points
        (n, 2), places.
    """
    found = np.full((len(points), field.shape[1]), np.nan)
    middles = cKDTree(nodes[elements[:, 8]])
    count = min(_NEAREST, len(elements))
    _, near = middles.query(points, count)
    near = near.reshape(len(points), count)
    for rank in range(count):
        left = np.flatnonzero(np.isnan(found[:, 0]))
        if not len(left):
            break
        element = elements[near[left, rank]]
        own = _own_coordinates(nodes[element], points[left])
        inside = np.abs(own).max(axis=1) <= _INSIDE
        values, _ = _shapes(own[inside, 0], own[inside, 1])
        found[left[inside]] = np.einsum("nk,nkc->nc", values, field[element[inside]])
    return found


def _own_coordinates(corners: Floats, points: Floats) -> Floats:
    """Return where points lie in their element's own coordinates, (n, 2); infinite where nowhere near."""
    own = np.zeros_like(points)
    for _ in range(_STEPS):
        values, slopes = _shapes(own[:, 0], own[:, 1])
        off = points - np.einsum("nk,nkc->nc", values, corners)
        jacobian = np.einsum("nki,nkc->nci", slopes, corners)
        own += np.clip(np.linalg.solve(jacobian + 1e-30 * np.eye(2), off[..., None])[..., 0], -1.0, 1.0)
    values, _ = _shapes(own[:, 0], own[:, 1])
    missed = np.linalg.norm(points - np.einsum("nk,nkc->nc", values, corners), axis=1)
    size = np.ptp(corners, axis=1).max(axis=1)
    own[missed > 1e-9 * size] = np.inf
    return own
