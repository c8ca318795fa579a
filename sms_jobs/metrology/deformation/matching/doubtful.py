"""Matches that contradict their neighbours, and points that were never reached: what becomes of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from sms_jobs.metrology.arrays import Floats, Ints, Labels, Mask
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    LEFT_IMAGE,
    NOT_CONVERGED,
    TOO_FEW_PIXELS,
    Matches,
)
from sms_jobs.metrology.deformation.matching.sampling import NEAREST, Nodes
from sms_jobs.metrology.deformation.matching.shape_functions import carried, shifted

_LEAST_SCATTER = 0.01  # px, of neighbours: what first-order subsets may disagree by on a curved field
_WITNESSES = 3  # neighbours that must have been matched to judge a point
_BLOCK = 1 << 15  # points whose neighbours are looked at together, for the memory's sake


def _expected(
    found: Matches, nodes: Nodes, points: Ints, told: Callable[[Floats, Ints, Ints], Floats]
) -> tuple[Floats, Mask]:
    """Return what is `told` at points by the warps of their nearest neighbours, (n, 8, numbers).

    It is NaN for the unmatched. And which of the points have enough neighbours that say something.
    """
    near = nodes.around[points, :NEAREST]
    usable = (near >= 0) & (found.ending[near] == CONVERGED)
    dx, dy = nodes.x[points, None] - nodes.x[near], nodes.y[points, None] - nodes.y[near]
    there = told(found.warp[near], dx, dy)
    return np.where(usable[..., None], there, np.nan), usable.sum(axis=1) >= _WITNESSES


def _medians(rows: Floats) -> Floats:
    """Return the median of what each of some short rows tells, NaN where it tells nothing.

    NumPy's own, which knows of masks, takes many times as long.
    """
    ordered = np.sort(rows, axis=1)  # NaN come last
    told = (~np.isnan(rows)).sum(axis=1)
    each = np.arange(len(rows))
    return np.asarray(0.5 * (ordered[each, (told - 1) // 2] + ordered[each, told // 2]))


def outliers(found: Matches, nodes: Nodes, points: Ints, ratio: float) -> Ints:
    """Return which of some matched points contradict their neighbours.

    Normalised median test (Westerweel & Scarano 2005) on displacements that the neighbours' warps carry to
    the point; their scatter counts as at least the point's own standard deviation, and 0.01 px.
    """
    outside = np.zeros(len(points), dtype=bool)
    for start in range(0, len(points), _BLOCK):
        own = points[start : start + _BLOCK]
        there, judged = _expected(found, nodes, own, shifted)
        judged &= found.ending[own] == CONVERGED
        block = outside[start : start + _BLOCK]
        for axis, value in enumerate((0, 3)):
            expected = there[judged, :, axis]
            middle = _medians(expected)
            scatter = _medians(np.abs(expected - middle[:, None]))
            least = np.maximum(_LEAST_SCATTER, found.sigma[own[judged], axis])
            deviation = np.abs(found.warp[own[judged], value] - middle)
            block[judged] |= deviation > ratio * np.maximum(scatter, least)
    return points[outside]


def check_again(
    found: Matches,
    nodes: Nodes,
    ratio: float,
    refine: Callable[[Ints, Floats], tuple[Matches, Mask]],
) -> None:
    """Match points again that contradict their neighbours, or were not matched beside some that were.

    They start from the median of what their neighbours' warps say. What contradicts the neighbours after
    that is no match.

    Parameters
    ----------
    found
        Of all points; changed in place.
    nodes
        The points and their neighbours.
    ratio
        Largest deviation from the neighbours, in units of their own scatter.
    refine
        Matches points from guesses, and says which of the results are sure.
    """
    every = np.arange(len(nodes.x))
    found.ending[outliers(found, nodes, every, ratio)] = NOT_CONVERGED
    doubtful = np.flatnonzero(found.ending == NOT_CONVERGED)
    guesses = []
    for start in range(0, len(doubtful), _BLOCK):
        own = doubtful[start : start + _BLOCK]
        there, judged = _expected(found, nodes, own, carried)
        guesses.append((own[judged], np.nanmedian(there[judged], axis=1)))
    if not guesses:
        return
    points, guess = (np.concatenate(parts) for parts in zip(*guesses, strict=True))
    again, sure = refine(points, guess)
    for mine, theirs in zip(vars(found).values(), vars(again).values(), strict=True):
        mine[points[sure]] = theirs[sure]
    found.ending[outliers(found, nodes, points[sure], ratio)] = NOT_CONVERGED


def nearest_warps(found: Matches, nodes: Nodes, region: Labels, points: Ints) -> Floats:
    """Return what the nearest match of its region says at points (n, numbers), NaN where there is none."""
    warp = np.full((len(points), found.warp.shape[1]), np.nan)
    place = np.stack([nodes.x, nodes.y], axis=1).astype(np.float64)
    matched = found.ending == CONVERGED
    for number in np.unique(region[points]):
        here = np.flatnonzero(region[points] == number)
        witnesses = np.flatnonzero(matched & (region == number))
        if len(witnesses) == 0:
            continue
        own = points[here]
        _, nearest = KDTree(place[witnesses]).query(place[own])
        source = witnesses[nearest]
        warp[here] = carried(found.warp[source], *(place[own] - place[source]).T)
    return warp


def mark_left_image(found: Matches, nodes: Nodes, labels: Labels, radius: int) -> None:
    """Mark unmatched points as having left the image, if the warp of the nearest match takes them out of it.

    A point has left where its end lies beyond the border; if its subset was too small, where its end is
    nearer to the border than a subset's radius and nearer than it was; and if its subset ran out of the
    image, where its end is near the border: elsewhere that was an iteration gone astray. `labels` are the
    reference image's; `found` is changed in place.
    """
    lost = np.flatnonzero(np.isin(found.ending, (NOT_CONVERGED, TOO_FEW_PIXELS, LEFT_IMAGE)))
    warp = nearest_warps(found, nodes, labels[nodes.y, nodes.x], lost)

    def room(x: Floats, y: Floats) -> Floats:
        """Return the distance from the nearest border, negative beyond it."""
        rows, columns = labels.shape
        return np.asarray(np.minimum(np.minimum(x, columns - 1.0 - x), np.minimum(y, rows - 1.0 - y)))

    x, y = nodes.x[lost].astype(np.float64), nodes.y[lost].astype(np.float64)
    before, after = room(x, y), room(x + warp[:, 0], y + warp[:, 3])
    cut = (found.ending[lost] == TOO_FEW_PIXELS) & (after < radius) & (after < before - 0.5)
    ran_out = found.ending[lost] == LEFT_IMAGE
    left = (after < 0.0) | cut | (ran_out & (after < 2.0 * radius))
    found.ending[lost[ran_out]] = NOT_CONVERGED
    found.ending[lost[left]] = LEFT_IMAGE
