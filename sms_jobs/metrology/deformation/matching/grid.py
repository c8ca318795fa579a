"""Matching of a whole grid of points: seeds first, then from neighbour to neighbour, then outliers.

Every wave matches all points that have a matched neighbour on their region, each from the neighbour with
the best score (reliability-guided, Pan 2009). A wave depends on the one before as a whole, so that the
result is the same however many threads share it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.deformation.matching.correlation import (
    AMBIGUOUS,
    CONVERGED,
    LEFT_IMAGE,
    NOT_CONVERGED,
    Matches,
    MatchSettings,
    PreparedImages,
    blank_matches,
    match_points,
)
from sms_jobs.metrology.deformation.matching.doubtful import check_again, mark_left_image, nearest_warps
from sms_jobs.metrology.deformation.matching.fourier_newton import match_by_cross_correlation
from sms_jobs.metrology.deformation.matching.sampling import NEAREST, Nodes, choose_seeds, sample_nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings, repeats_itself, seed_warps
from sms_jobs.metrology.deformation.matching.shape_functions import WARP, carried

Method: TypeAlias = Literal["gauss-newton", "fourier-newton"]

REFINEMENT: Final[dict[Method, Callable[..., Matches]]] = {
    "gauss-newton": match_points,
    "fourier-newton": match_by_cross_correlation,
}
"""The function behind each method."""

_ATTEMPTS = 3  # times that a point is tried from ever better neighbours
_SEED_SCORE = 0.4  # of an integer shift: a poor start, but the refinement judges it


@dataclass(frozen=True)
class GridMatches:
    """Matches at the nodes of a grid that lie on a region: `x`, `y` (n,) in px and the rest."""

    x: Ints
    y: Ints
    matches: Matches


@dataclass(frozen=True)
class Seeds:
    """Points that matching begins at: their indices (n,), and guesses of their warps, (n, 6)."""

    points: Ints
    guess: Floats

    @classmethod
    def none(cls) -> Seeds:
        """Return no seed."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 6)))


@dataclass(frozen=True)
class GridSettings:
    """How a grid of points is matched.

    Attributes
    ----------
    spacing
        Of the grid, in px.
    edge_spacing
        Near the regions' edges, in px; None for that of the grid: see `sample_nodes`.
    minimum_score
        Lowest zero-normalised cross-correlation that is accepted.
    maximum_sigma
        Largest standard deviation of u or v that is accepted, in px.
    outlier_ratio
        Largest deviation from the neighbours, in units of their own scatter.
    method
        How each point is matched: see `match_points` and `match_by_cross_correlation`.
    """

    spacing: int = 4
    edge_spacing: int | None = None
    minimum_score: float = 0.8
    maximum_sigma: float = 0.05
    outlier_ratio: float = 6.0
    method: Method = "gauss-newton"


def is_sure(found: Matches, grid: GridSettings) -> Mask:
    """Return which matches have converged with a score and standard deviations that are accepted."""
    with np.errstate(invalid="ignore"):
        sure = (found.score >= grid.minimum_score) & (found.sigma.max(axis=1) <= grid.maximum_sigma)
    return np.asarray((found.ending == CONVERGED) & sure)


def match_grid(
    images: PreparedImages,
    deformed: NDArray[np.generic],
    settings: MatchSettings,
    grid: GridSettings,
    search: SearchSettings,
    threads: int = 1,
) -> GridMatches:
    """Match a regular grid of points of every region.

    Parameters
    ----------
    images
        Reference image, its regions, and the deformed image, prepared.
    deformed
        (rows, columns), the deformed image, for the seeds.
    settings, grid, search
        Of the subsets, of the grid, and of the seeds.
    threads
        How many threads to use; the result does not depend on it.
    """
    nodes = sample_nodes(images.labels, grid.spacing, grid.edge_spacing)
    return match_nodes(images, deformed, nodes, settings, grid, search, threads)


def match_nodes(
    images: PreparedImages,
    deformed: NDArray[np.generic],
    nodes: Nodes,
    settings: MatchSettings,
    grid: GridSettings,
    search: SearchSettings,
    threads: int = 1,
    known: GridMatches | None = None,
) -> GridMatches:
    """Match points whose neighbours are known; parameters as of `match_grid`, `known` of `spread_matches`."""
    if len(nodes.x) == 0:
        return spread_matches(images, nodes, Seeds.none(), settings, grid, threads)
    first = choose_seeds(images.labels, nodes.x, nodes.y, search)
    guess, score = seed_warps(
        images.reference, deformed, images.labels, nodes.x[first], nodes.y[first], search, threads
    )
    again = repeats_itself(images.reference, images.labels, nodes.x[first], nodes.y[first], search, threads)
    likely = (score >= _SEED_SCORE) & ~again
    seeds = Seeds(first[likely], guess[likely])
    # Only where the texture is its own can a match that nothing leads to be the right one.
    alone = ~again[KDTree(_places(nodes, first)).query(_places(nodes))[1]]
    found = spread_matches(images, nodes, seeds, settings, grid, threads, may_rest=alone, known=known)
    found.matches.ending[(found.matches.ending == NOT_CONVERGED) & ~alone] = AMBIGUOUS
    return found


def _places(nodes: Nodes, which: Ints | slice = slice(None)) -> Floats:
    return np.stack([nodes.x[which], nodes.y[which]], axis=1).astype(np.float64)


def spread_matches(
    images: PreparedImages,
    nodes: Nodes,
    seeds: Seeds,
    settings: MatchSettings,
    grid: GridSettings,
    threads: int = 1,
    *,
    may_rest: Mask | None = None,
    known: GridMatches | None = None,
) -> GridMatches:
    """Match points whose neighbours are known, from seeds on; parameters as of `match_grid`.

    A point of a region that no match leads to is tried where it was, if it is one of `may_rest` (n,). What
    became of points that are `known` stands, and they lead to others.
    """
    x, y, around = nodes.x, nodes.y, nodes.around
    with_bends = settings.shape_order == 2 and grid.method == "gauss-newton"
    found = blank_matches(len(x), WARP if with_bends else 6)
    if len(x) == 0:
        return GridMatches(x, y, found)
    attempts = np.zeros(len(x), dtype=np.int64)
    started_from = np.zeros(len(x))
    done = np.zeros(len(x), dtype=bool)

    def attempt(points: Ints, guess: Floats) -> None:
        result = REFINEMENT[grid.method](images, x[points], y[points], guess, settings, threads)
        good = is_sure(result, grid)
        result.ending[(result.ending == CONVERGED) & ~good] = NOT_CONVERGED
        for mine, theirs in zip(vars(found).values(), vars(result).values(), strict=True):
            mine[points] = theirs
        done[points] = good
        attempts[points] += 1
        # Only a better start can help a point that went astray; nothing helps one without texture.
        lost = (result.ending != CONVERGED) & (result.ending != NOT_CONVERGED) & (result.ending != LEFT_IMAGE)
        attempts[points[lost]] = _ATTEMPTS + 1

    mine, theirs = _shared(x, y, known)
    for into, given in zip(
        vars(found).values(), vars(known.matches if known else found).values(), strict=True
    ):
        into[mine] = given[theirs]
    done[mine] = found.ending[mine] == CONVERGED
    attempts[mine] = _ATTEMPTS + 1
    new = attempts[seeds.points] == 0
    attempt(seeds.points[new], seeds.guess[new])
    fresh = np.union1d(seeds.points, mine)
    while True:
        pending = _beside(fresh[done[fresh]], around, ~done & (attempts <= _ATTEMPTS))
        source, quality = _best_neighbours(around[pending], done, found.score)
        better = (quality > -np.inf) & ((attempts[pending] == 0) | (quality > started_from[pending] + 1e-3))
        pending, source, quality = pending[better], source[better], quality[better]
        if len(pending) == 0:
            break
        started_from[pending], fresh = quality, pending
        attempt(pending, carried(found.warp[source], x[pending] - x[source], y[pending] - y[source]))

    def refine(points: Ints, guess: Floats) -> tuple[Matches, Mask]:
        result = REFINEMENT[grid.method](images, x[points], y[points], guess, settings, threads)
        return result, is_sure(result, grid)

    # Points that no neighbour has reached may have no texture, or lie on an island with its own displacement.
    unreached = np.flatnonzero(attempts == 0)
    guess = nearest_warps(found, nodes, images.labels[y, x], unreached)
    led = np.isfinite(guess[:, 0])
    if may_rest is not None:
        led |= may_rest[unreached]
    attempt(unreached[led], np.where(np.isfinite(guess), guess, 0.0)[led])
    check_again(found, nodes, grid.outlier_ratio, refine)
    mark_left_image(found, nodes, images.labels, settings.radius)
    return GridMatches(x, y, found)


def _beside(fresh: Ints, around: Ints, unsettled: Mask) -> Ints:
    """Return which points that are open (n,) have a neighbour that has just been matched.

    No other can have a better start than before.
    """
    beside = np.zeros(len(unsettled) + 1, dtype=bool)  # the last is that of no neighbour, -1
    beside[around[fresh]] = True
    return np.flatnonzero(beside[:-1] & unsettled)


def _best_neighbours(near: Ints, done: Mask, score: Floats) -> tuple[Ints, Floats]:
    """Return which neighbour (m,) of each point is best matched, and its score; -inf where none is.

    near is (m, neighbours), with -1 for none; done and score are those of all points.
    """
    scores = np.where((near >= 0) & done[near], score[near], -np.inf)
    scores[:, NEAREST:] -= 1.0  # the second ring only where the first has nothing
    best = np.argmax(scores, axis=1)
    rows = np.arange(len(near))
    return near[rows, best], scores[rows, best]


def _shared(x: Ints, y: Ints, known: GridMatches | None) -> tuple[Ints, Ints]:
    """Return the indices of points (n,) that are known, and of the known ones that they are."""
    if known is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    width = np.int64(max(x.max(), known.x.max(initial=0)) + 1)
    _, mine, theirs = np.intersect1d(y * width + x, known.y * width + known.x, return_indices=True)
    return mine, theirs
