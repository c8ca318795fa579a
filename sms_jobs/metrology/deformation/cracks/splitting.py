"""Regions of the reference that have come apart by the deformed state: a crack, a disbond.

The measured shape of the deformed state tells, or, of a camera alone, where the images disagree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from sms_jobs.metrology.arrays import Floats, Ints, Labels, Mask
from sms_jobs.metrology.deformation.matching.shape_functions import carried

_LEAST_PART = 0.05  # of a region's matched points that must lie in a piece of it
_LEAST_POINTS = 6
_LEAST_CLUSTER = 12  # px that disagree together: noise alone makes a few do so


@dataclass(frozen=True)
class Split:
    """Regions of the reference, parted where the deformed state has parted them.

    Attributes
    ----------
    labels
        (rows, columns); the largest piece of a region keeps its number, the others have new ones.
    pieces
        The numbers of the pieces of each region that has come apart.
    """

    labels: Labels
    pieces: dict[int, tuple[int, ...]]


def split_regions(labels: Labels, end_labels: Labels, x: Ints, y: Ints, warp: Floats) -> Split:
    """Part the regions of the reference whose matched points have come to several regions.

    Parameters
    ----------
    labels, end_labels
        (rows, columns), regions of the reference and of the deformed state, 0 for none.
    x, y
        (n,), matched points of the reference, in px.
    warp
        (n, 6), their warps.

    Notes
    -----
    A piece holds at least a twentieth of the region's matched points, and half of those that end there.
    Each pixel belongs to the piece in which it ends by the warp of the matched point nearest to it or, where
    there is none, to that point's.
    """
    found, pieces = labels.copy(), {}
    region = labels[y, x]
    ends = _label_at(end_labels, x + warp[:, 0], y + warp[:, 3])
    following = int(labels.max()) + 1
    totals = np.bincount(ends, minlength=1)
    for number in range(1, following):
        own = np.flatnonzero(region == number)
        count = np.bincount(ends[own], minlength=len(totals))
        # An end that mostly points of other regions reach is not this region's, though they touch.
        count[2 * count < totals] = 0
        count[0] = 0
        least = max(_LEAST_PART * len(own), _LEAST_POINTS)
        large = [int(k) for k in np.argsort(-count, kind="stable") if count[k] >= least]
        if len(large) < 2:
            continue
        rows, columns = np.nonzero(labels == number)
        names = [number, *range(following, following + len(large) - 1)]
        following += len(large) - 1
        name = np.zeros(int(end_labels.max()) + 1, dtype=np.int32)
        name[large] = names
        witnesses = own[name[ends[own]] > 0]
        _, nearest = KDTree(np.stack([x[witnesses], y[witnesses]], axis=1)).query(
            np.stack([columns, rows], axis=1)
        )
        source = witnesses[nearest]
        there = carried(warp[source], columns - x[source], rows - y[source])
        piece = name[_label_at(end_labels, columns + there[:, 0], rows + there[:, 3])]
        found[rows, columns] = np.where(piece > 0, piece, name[ends[source]])
        pieces[number] = tuple(names)
    return Split(found, pieces)


def _label_at(labels: Labels, x: Floats, y: Floats) -> Labels:
    """Return the labels of the pixels nearest to places, 0 beyond the image."""
    column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    rows, columns = labels.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return np.where(inside, labels[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)], 0)


def cut_out(labels: Labels, disagree: Mask, least_area: int) -> Labels | None:
    """Take out of regions what two images disagree on, and part what holds together by it alone.

    Parameters
    ----------
    labels
        (rows, columns), 0 for no region.
    disagree
        (rows, columns); clusters of fewer than 12 pixels are left to be chance.
    least_area
        Smaller pieces are dropped, in px.

    Returns
    -------
    (rows, columns): the largest piece of a region keeps its number, others have new ones; None where there
    is nothing to take out.
    """
    import cv2

    def pieces(of: Mask) -> tuple[Labels, Ints]:
        _, numbers, table, _ = cv2.connectedComponentsWithStats(of.astype(np.uint8), connectivity=4)
        return np.asarray(numbers, dtype=np.int32), np.asarray(table[:, cv2.CC_STAT_AREA], dtype=np.int64)

    cluster, area = pieces(disagree & (labels > 0))
    area[0] = 0
    out = (area >= _LEAST_CLUSTER)[cluster]
    if not out.any():
        return None
    found = np.zeros_like(labels)
    following = int(labels.max()) + 1
    for number in np.unique(labels[labels > 0]):
        piece, area = pieces((labels == number) & ~out)
        area[0] = 0
        name = np.zeros(len(area), dtype=np.int32)
        for rank, k in enumerate(np.argsort(-area, kind="stable")):
            if area[k] < max(least_area, 1):
                break
            name[k] = number if rank == 0 else following
            following += rank > 0
        found += name[piece]
    return found
