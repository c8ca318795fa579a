"""Brings dots into the order of a square lattice, seen under any angle, bent by a lens, with gaps."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.spatial import cKDTree

from sms_jobs.metrology.arrays import Floats, Ints, Ints32

_NEIGHBOURS = 16
_SEEDS = 40
_STEP_TOLERANCE = 0.25  # of a step: perspective and bend change a step by a tenth, clutter is anywhere
_RIGHT_ANGLE_TOLERANCE = 0.35  # cosine, in a frame in which the dot is a circle
_OPPOSITE_TOLERANCE = 0.35
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def lattice_places(centre: Floats, matrix: Floats, step_over_radius: float) -> tuple[Ints, Ints32]:
    """Find the largest square lattice among dots.

    A dot is a circle, hence M, which makes its image one, makes the lattice about it square: neighbours are
    at a known distance and at right angles there. From a dot with four such neighbours the lattice is
    walked dot by dot, each step predicted from those before it.

    Parameters
    ----------
    centre
        (n, 2), in px.
    matrix
        (n, 2, 2), M of the ellipses |M (x - c)| = 1, in 1/px.
    step_over_radius
        Distance of neighbours over the radius of a dot.

    Returns
    -------
    (m,), which dots are on the lattice, and (m, 2), their places: integers from an arbitrary origin, in an
    arbitrary one of the four orientations that are not mirrored (first x second points into the image).
    """
    best: dict[int, tuple[int, int]] = {}
    done: set[int] = set()
    if len(centre) >= 5:
        tree = cKDTree(centre)
        _, near = tree.query(centre, k=min(_NEIGHBOURS, len(centre)))
        seeds = [
            (i, cross)
            for i in range(len(centre))
            if (cross := _cross(i, near[i], centre, matrix, step_over_radius))
        ]
        tried = 0
        for seed, cross in seeds:
            if seed in done or tried == _SEEDS:
                continue
            walked = _walk(seed, cross, centre, matrix, tree, step_over_radius)
            tried += 1
            done.update(walked)
            if len(walked) > len(best):
                best = walked
    which = np.array(sorted(best), dtype=np.int64)
    return which, np.array([best[int(i)] for i in which], dtype=np.int32).reshape(-1, 2)


def _cross(i: int, near: Ints, centre: Floats, matrix: Floats, step: float) -> tuple[int, int] | None:
    """Return the neighbours of dot i along the first and second direction, if it has all four."""
    others = near[near != i]
    q = (centre[others] - centre[i]) @ matrix[i]
    length = np.hypot(q[:, 0], q[:, 1])
    right = (length > 0.7 * step) & (length < 1.35 * step)
    others, q, length = others[right], q[right], length[right]
    if not 4 <= len(others) <= 8:
        return None
    unit = q / length[:, None]
    for a in np.argsort(length)[:2]:
        cosine = unit @ unit[a]
        sine = unit[a, 0] * unit[:, 1] - unit[a, 1] * unit[:, 0]
        across = np.flatnonzero((np.abs(cosine) < _RIGHT_ANGLE_TOLERANCE) & (sine > 0.0))
        back = np.flatnonzero((np.abs(cosine) < _RIGHT_ANGLE_TOLERANCE) & (sine < 0.0))
        opposite = np.flatnonzero(cosine < -0.9)
        if len(across) != 1 or len(back) != 1 or len(opposite) != 1:
            continue
        sums = np.hypot(*(q[a] + q[opposite[0]])), np.hypot(*(q[across[0]] + q[back[0]]))
        if max(sums) < _OPPOSITE_TOLERANCE * step:
            return int(others[a]), int(others[across[0]])
    return None


def _walk(
    seed: int, cross: tuple[int, int], centre: Floats, matrix: Floats, tree: cKDTree, step: float
) -> dict[int, tuple[int, int]]:
    """Return the places of all dots that can be reached from a seed."""
    at: dict[tuple[int, int], int] = {(0, 0): seed}
    place: dict[int, tuple[int, int]] = {seed: (0, 0)}
    ways = {seed: (centre[cross[0]] - centre[seed], centre[cross[1]] - centre[seed])}
    queue = deque([seed])
    while queue:
        i = queue.popleft()
        here = place[i]
        for dx, dy in _STEPS:
            to = (here[0] + dx, here[1] + dy)
            if to in at:
                continue
            before = at.get((here[0] - dx, here[1] - dy))
            way = ways[i][0] * dx + ways[i][1] * dy
            if before is not None:
                way = centre[i] - centre[before]
            # A known neighbour's step beside this one tells how steps shrink along the way.
            for side in ((dy, dx), (-dy, -dx)):
                a, b = (
                    at.get((here[0] + side[0], here[1] + side[1])),
                    at.get((to[0] + side[0], to[1] + side[1])),
                )
                if a is not None and b is not None:
                    way = centre[b] - centre[a]
            length = float(np.hypot(way[0], way[1]))
            distance, j = tree.query(centre[i] + way)
            j = int(j)
            if j in place or distance > _STEP_TOLERANCE * length:
                continue
            # The neighbour is a dot of the same board: its own shape must say about the same distance.
            if not 0.5 * step < float(np.hypot(*(matrix[j] @ way))) < 1.8 * step:
                continue
            found = centre[j] - centre[i]
            first, second = ways[i]
            ways[j] = (found * dx, second) if dx else (first, found * dy)
            at[to], place[j] = j, to
            queue.append(j)
    return place
