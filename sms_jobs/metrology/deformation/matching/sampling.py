"""Where points are matched: a grid of nodes on regions, finer near the regions' edges (thesis Fig. 39)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Ints, Labels, Singles
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.images.masks import distance_inside, of_one_label

NEAREST = 8
"""Neighbours of the first ring, which come first."""

_RINGS = tuple(
    sorted(
        ((j, i) for j in range(-2, 3) for i in range(-2, 3) if (j, i) != (0, 0)),
        key=lambda step: (max(abs(step[0]), abs(step[1])), abs(step[0]) + abs(step[1])),
    )
)


@dataclass(frozen=True)
class Nodes:
    """Points to be matched and who their neighbours are.

    Attributes
    ----------
    x, y
        (n,), in px.
    around
        (n, k), indices of neighbours on the same region, the first ring's eight before the others; -1 for
        none.
    """

    x: Ints
    y: Ints
    around: Ints


def depth_in_region(labels: Labels) -> Singles:
    """Return how far each pixel (rows, columns) lies inside its region, in px; the image's border ends it."""
    return distance_inside(np.pad(of_one_label(labels, 3), 1))[1:-1, 1:-1]


def sample_nodes(labels: Labels, spacing: int, edge_spacing: int | None = None) -> Nodes:
    """Return the nodes of a grid that lie on a region, with more of them near the regions' edges.

    Parameters
    ----------
    labels
        (rows, columns), 0 where there is no region.
    spacing
        In px.
    edge_spacing
        Within `spacing` of a region's edge, in px; a divisor of `spacing`, at least a quarter of it. None
        for no more nodes there.
    """
    fine = edge_spacing or spacing
    ratio = spacing // fine
    offset = (spacing // 2) % fine
    region = labels[offset::fine, offset::fine]
    row, column = np.ogrid[: region.shape[0], : region.shape[1]]
    first = (spacing // 2) // fine
    coarse = (row % ratio == first % ratio) & (column % ratio == first % ratio) & (region > 0)
    taken = coarse
    if ratio > 1:
        # The border of the image is no edge: what lies beyond it is the same surface.
        padded = np.pad(labels, spacing + 1, mode="edge")
        depth = depth_in_region(padded)[spacing + 1 : -spacing - 1, spacing + 1 : -spacing - 1]
        taken = coarse | ((region > 0) & (depth[offset::fine, offset::fine] < spacing))
    rows, columns = np.nonzero(taken)
    node = np.full(taken.shape, -1, dtype=np.int64)
    node[rows, columns] = np.arange(len(rows))
    own = region[rows, columns]
    near = _neighbours(node, own, rows, columns, 1)
    if ratio > 1:
        far = _neighbours(node, own, rows, columns, ratio)
        # Each in its own measure first, so that the first ring is a ring.
        deep = depth[offset::fine, offset::fine][rows, columns] >= spacing
        near = np.where(deep[:, None], np.concatenate([far, near], 1), np.concatenate([near, far], 1))
    return Nodes(offset + fine * columns, offset + fine * rows, near)


def _neighbours(node: Ints, region: Labels, rows: Ints, columns: Ints, step: int) -> Ints:
    """Return the indices (n, 24) of each node's neighbours on its region, nearest first, -1 for none."""
    reach = 2 * step
    padded = np.pad(node, reach, constant_values=-1)
    around = np.stack(
        [padded[rows + reach + step * j, columns + reach + step * i] for j, i in _RINGS], axis=1
    )
    return np.where((around >= 0) & (region[around] == region[:, None]), around, -1)


def choose_seeds(labels: Labels, x: Ints, y: Ints, search: SearchSettings) -> Ints:
    """Return the indices of one point for every region in every square of `search.spacing` px.

    It is the one nearest to the square's middle whose sub-image lies wholly on its region; where there is
    none, the one farthest from the region's edge.
    """
    depth = depth_in_region(labels)[y, x]
    row, column = y // search.spacing, x // search.spacing
    off_middle = np.hypot(*((v % search.spacing) - 0.5 * search.spacing for v in (x, y)))
    order = np.lexsort((off_middle, -np.minimum(depth, search.template_radius)))
    which = (labels[y, x], row, column)
    squares = np.ravel_multi_index(which, tuple(int(numbers.max(initial=0)) + 1 for numbers in which))
    _, first = np.unique(squares[order], return_index=True)
    return np.asarray(np.sort(order[first]))
