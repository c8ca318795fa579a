"""Scattered points that lie along a line, in their order and evenly spaced."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array, csgraph
from scipy.spatial import KDTree

from sms_jobs.metrology.arrays import Floats, Ints


def ways(place: Floats, reach: float, least: float) -> Iterator[Ints]:
    """Yield which of some points lie on ways through them, each in its order; branches are ways of their own.

    Parameters
    ----------
    place
        (n, 2).
    reach
        The longest step.
    least
        Shorter ways are left out.

    Notes
    -----
    A way is the diameter of the minimum spanning tree of the steps that are not too long. Points within half
    of `reach` of one belong to it.
    """
    groups = list(_groups(np.arange(len(place)), place, reach))
    while groups:
        group = groups.pop()
        way = group[_diameter(place[group], reach)]
        if way_along(place[way])[-1] < least:
            continue
        yield way
        distance, _ = KDTree(place[way]).query(place[group])
        groups += _groups(group[distance > 0.5 * reach], place, reach)


def _steps(place: Floats, reach: float) -> Any:
    pairs = KDTree(place).query_pairs(reach, output_type="ndarray")
    length = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1)
    return coo_array((length, (pairs[:, 0], pairs[:, 1])), shape=(len(place), len(place))).tocsr()


def _groups(chosen: Ints, place: Floats, reach: float) -> Iterator[Ints]:
    """Yield which of the chosen points steps lead to each other."""
    if len(chosen):
        _, member = csgraph.connected_components(_steps(place[chosen], reach), directed=False)
        order = np.argsort(member, kind="stable")
        for group in np.split(order, np.flatnonzero(np.diff(member[order])) + 1):
            yield chosen[group]


def _diameter(place: Floats, reach: float) -> Ints:
    tree = csgraph.minimum_spanning_tree(_steps(place, reach))
    one, _ = _farthest(tree, 0)
    other, before = _farthest(tree, one)
    way = [other]
    while way[-1] != one:
        way.append(int(before[way[-1]]))
    return np.array(way, dtype=np.int64)


def _farthest(tree: Any, start: int) -> tuple[int, NDArray[np.int32]]:
    """Return the point of a tree that is farthest from one of them, and the way there."""
    distance, before = csgraph.dijkstra(tree, directed=False, indices=start, return_predecessors=True)
    return int(np.argmax(distance)), before


def way_along(place: Floats) -> Floats:
    """Return how far from the first of some points (n, k) in order each lies along their line."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])


def evened(values: Floats, way: Floats, width: float) -> Floats:
    """Return at every unit along a line what its points (n, ...) at `way` (n,) have, by a Gaussian filter."""
    at = np.arange(int(way[-1]) + 1.0)
    even = np.stack([np.interp(at, way, column) for column in values.reshape(len(way), -1).T], axis=1)
    filtered = ndimage.gaussian_filter1d(even, width, axis=0, mode="nearest")
    return np.asarray(filtered.reshape(len(at), *values.shape[1:]))
