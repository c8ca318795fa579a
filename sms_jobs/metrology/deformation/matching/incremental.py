"""Large deformation, step by step: a point is followed from state to state where one step is too long.

A point's place in the state before is known, to a part of a pixel, with its deformation since the reference.
The subset about the nearest whole pixel there is matched with the present state, and both displacements are
put together. Where the reference itself can be matched from that start, the sum is not needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    LEFT_IMAGE,
    NOT_CONVERGED,
    TOO_FEW_PIXELS,
    Matches,
    MatchSettings,
    PreparedImages,
    blank_matches,
)
from sms_jobs.metrology.deformation.matching.grid import (
    REFINEMENT,
    GridMatches,
    GridSettings,
    is_sure,
    match_nodes,
)
from sms_jobs.metrology.deformation.matching.sampling import Nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.deformation.matching.shape_functions import WARP, carried


@dataclass(frozen=True)
class Followed:
    """Where points have come to by the state before.

    Attributes
    ----------
    warp
        (n, 6) since the reference state, as of `match_points`; NaN where a point was lost.
    sigma
        (n, 2), standard deviations of u and v in px.
    steps
        (n,), correlations whose displacements have been added; 0 for a lost point.
    """

    warp: Floats
    sigma: Floats
    steps: NDArray[np.int32]


def compose(first: Floats, second: Floats) -> Floats:
    """Return the warps (n, 6) that lead through `first` (n, 6) and then through `second` (n, 6).

    Both are displacement and its gradient at the point, `second` at where `first` ends:
    u = u1 + u2 and 1 + grad u = (1 + grad u2)(1 + grad u1).
    """
    total = first + second
    for i, value in ((0, 1), (3, 4)):
        for j in (1, 2):
            total[:, i + j] += second[:, value] * first[:, j] + second[:, value + 1] * first[:, 3 + j]
    return total


def shared_noise(step: Floats, radius: int) -> Floats:
    """Return which part (n,) of a step's variance the step before takes back again.

    The noise of the image between them moves the end of the one and the start of the other alike, as far as
    both see the same pixels: a square subset of some radius about the nearest whole pixel, and the one
    before, which its step (n, 6) has deformed. With the part `lost` of the square that they do not share it
    is 1 - 3 lost: by trial, for rotations of 1 to 12 degrees and strains up to 3 % a step.
    """
    stretch, turn = np.abs(step[:, [1, 5]]).sum(axis=1), np.abs(step[:, [2, 4]]).sum(axis=1)
    lost = 0.5 * stretch + 0.25 * turn + 0.25 / radius
    return np.asarray(np.clip(1.0 - 3.0 * lost, 0.0, 1.0))


def composed_sigma(first: Floats, second_warp: Floats, second: Floats, shared: Floats) -> Floats:
    """Return the standard deviations (n, 2) of composed displacements: the first, carried on, and the second.

    The first, (n, 2), is carried through the second step, (n, 6); of the second's own variance the part
    `shared`, (n,), is left out.
    """
    variance = (1.0 - shared[:, None]) * second**2
    for i, (row, one) in enumerate(((1, 0), (4, 1))):
        for j in (0, 1):
            slope = second_warp[:, row + j] + (1.0 if j == one else 0.0)
            variance[:, i] += slope**2 * first[:, j] ** 2
    return np.asarray(np.sqrt(variance))


def follow(
    images: PreparedImages,
    deformed: NDArray[np.generic],
    nodes: Nodes,
    before: Followed,
    settings: MatchSettings,
    grid: GridSettings,
    search: SearchSettings,
    threads: int = 1,
) -> tuple[Matches, NDArray[np.int32]]:
    """Follow points of the reference from the state before to the present one.

    Parameters
    ----------
    images
        The state before, with its regions, and the present state, prepared.
    deformed
        (rows, columns), the present state, for the seeds.
    nodes
        The points in the reference, and their neighbours there.
    before
        Where they have come to.
    settings, grid, search
        As of `match_grid`.

    Returns
    -------
    Matches from the reference to the present state, and how many steps each is made of, 0 without a match.
    A point that was lost before has ended as not converged; one that came to no region, with too few pixels.
    """
    shape = images.labels.shape
    total = blank_matches(len(nodes.x), 6)
    known = np.flatnonzero(np.isfinite(before.warp).all(axis=1))
    place = np.stack([nodes.x[known] + before.warp[known, 0], nodes.y[known] + before.warp[known, 3]])
    whole = np.rint(place).astype(np.int64)
    inside = ((whole >= 0) & (whole < np.array(shape[::-1])[:, None])).all(axis=0)
    total.ending[known[~inside]] = LEFT_IMAGE
    known, place, whole = known[inside], place[:, inside], whole[:, inside]
    on_region = images.labels[whole[1], whole[0]] > 0
    total.ending[known[~on_region]] = TOO_FEW_PIXELS
    known, place, whole = known[on_region], place[:, on_region], whole[:, on_region]
    number = np.full(len(nodes.x) + 1, -1, dtype=np.int64)
    number[known] = np.arange(len(known))
    moved = Nodes(whole[0], whole[1], number[nodes.around[known]])
    step = match_nodes(images, deformed, moved, settings, grid, search, threads).matches
    steps = np.zeros(len(nodes.x), dtype=np.int32)
    last = carried(step.warp, place[0] - whole[0], place[1] - whole[1])[:, :6]
    good = step.ending == CONVERGED
    total.warp[known[good]] = compose(before.warp[known[good]], last[good])
    total.sigma[known[good]] = composed_sigma(
        before.sigma[known[good]], last[good], step.sigma[good], shared_noise(last[good], settings.radius)
    )
    for mine, theirs in (
        (total.score, step.score),
        (total.iterations, step.iterations),
        (total.ending, step.ending),
    ):
        mine[known] = theirs
    steps[known[good]] = before.steps[known[good]] + 1
    return total, steps


def match_in_steps(
    direct: PreparedImages,
    last: PreparedImages,
    deformed: NDArray[np.generic],
    nodes: Nodes,
    before: Followed,
    settings: MatchSettings,
    grid: GridSettings,
    search: SearchSettings,
    threads: int = 1,
) -> tuple[GridMatches, NDArray[np.int32]]:
    """Match points with the reference where that is possible, and in steps where it is not.

    A point that is lost from the reference is followed from the state before; the reference is then tried
    again from where that leads to, and what it gives is taken if it is sure: it has no errors of earlier
    steps.

    Parameters
    ----------
    direct, last
        The reference and the state before, each with its regions, and the present state.
    deformed, nodes, before, settings, grid, search
        As of `follow`.

    Returns
    -------
    The matches, and how many steps each is made of: 1 for the reference itself, 0 without a match.
    """
    found = match_nodes(direct, deformed, nodes, settings, grid, search, threads)
    steps = (found.matches.ending == CONVERGED).astype(np.int32)
    lost = np.flatnonzero(steps == 0)
    if len(lost) == 0:
        return found, steps
    # The neighbours that were found lend their help: all are followed, and the lost ones are taken.
    followed, followed_steps = follow(last, deformed, nodes, before, settings, grid, search, threads)
    helped = lost[followed_steps[lost] > 0]
    start = followed.warp[helped]
    if found.matches.warp.shape[1] == WARP:
        start = np.pad(start, ((0, 0), (0, WARP - 6)))
    again = REFINEMENT[grid.method](direct, nodes.x[helped], nodes.y[helped], start, settings, threads)
    sure = is_sure(again, grid) & _agree(again, followed, helped)
    _take(found.matches, helped[sure], again, np.flatnonzero(sure))
    steps[helped[sure]] = 1
    left = helped[~sure]
    _take(found.matches, left, replace(followed, warp=_as_wide(followed.warp, found.matches.warp)), left)
    steps[left] = followed_steps[left]
    # A reason from the step is better than none: it left the image, or came to no surface.
    nothing = lost[followed_steps[lost] == 0]
    explained = nothing[followed.ending[nothing] != NOT_CONVERGED]
    found.matches.ending[explained] = followed.ending[explained]
    return found, steps


def _agree(again: Matches, followed: Matches, which: Ints) -> Mask:
    """Return which direct matches lie within five standard deviations, and half a pixel, of the steps."""
    apart = np.abs(again.warp[:, [0, 3]] - followed.warp[which][:, [0, 3]])
    with np.errstate(invalid="ignore"):
        return np.asarray((apart < 0.5 + 5.0 * followed.sigma[which]).all(axis=1))


def _as_wide(warp: Floats, like: Floats) -> Floats:
    """Return warps with as many numbers as others have."""
    return np.pad(warp, ((0, 0), (0, like.shape[1] - warp.shape[1])))


def _take(into: Matches, where: Ints, source: Matches, which: Ints) -> None:
    """Copy matches."""
    for mine, theirs in zip(vars(into).values(), vars(source).values(), strict=True):
        mine[where] = theirs[which]
