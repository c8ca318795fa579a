"""In which order the fringe orders of a list of densities are resolved.

A plan, made once for a list, climbs over rungs, each a density or an integer combination of two (such as
32 - 31), from one fringe across the projector up to every density. The thesis's linear, forward and reverse
exponential sequences (its Fig. 10) are cases of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, pairwise, product
from math import gcd

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints, Mask

_LARGEST_FACTOR = 8  # of the combinations that are tried where no two densities differ by one fringe
_ROUNDING = 1e-9  # of densities that are no whole numbers
_ALL_PAIRS_UP_TO = 32  # densities; a longer list is dense, and its neighbours' differences suffice


@dataclass(frozen=True)
class Plan:
    """How a list of densities is unwrapped.

    Attributes
    ----------
    densities
        As given.
    first, second
        Index of each rung's densities, (rungs,).
    factors
        (rungs, 2): the rung's phase is factors[0] phase[first] + factors[1] phase[second].
    below
        Rung whose omega predicts this one's phase; -1 for the lowest.
    density
        Of each rung: factors[0] t[first] + factors[1] t[second].
    top
        Rung of each density by itself.
    amplification
        Largest standard deviation of a rung's prediction error, in units of that of a single phase.
    """

    densities: tuple[float, ...]
    first: Ints
    second: Ints
    factors: Floats
    below: Ints
    density: Floats
    top: Ints
    amplification: float


@lru_cache(maxsize=64)
def unwrapping_plan(densities: tuple[float, ...], known_coarsely: bool = False) -> Plan:
    """Plan how to unwrap a list of densities so that the least certain step is as certain as can be.

    The prediction of rung s from rung r has the error c_s - (d_s / d_r) c_r in units of the phase noise,
    c being the factors of the phases and d the rung's density. From the rungs of one fringe, which need no
    prediction, the path to each density is the one with the smallest largest error. Where omega is
    `known_coarsely` from elsewhere, paths begin at the lowest density.

    Raises `InvalidInput` for a list that leaves omega ambiguous within -pi .. pi.
    """
    t = np.array(densities, dtype=np.float64)
    rungs = _candidates(densities)
    d = rungs @ t
    start = np.array([t.argmin()]) if known_coarsely else np.flatnonzero(_start(d))
    if not start.size:
        raise InvalidInput(_why_ambiguous(densities))
    noise = np.sum(rungs * rungs, axis=1)
    worst = np.full(d.size, np.inf)
    worst[start] = 0.0
    tie = np.full(d.size, np.inf)
    tie[start] = noise[start]
    below = np.full(d.size, -1)
    left = np.ones(d.size, dtype=bool)
    top = np.arange(len(densities))
    while left[top].any():
        open_rungs = np.flatnonzero(left)
        r = open_rungs[np.lexsort((tie[open_rungs], worst[open_rungs]))[0]]
        left[r] = False
        growth = d / d[r]
        error = noise - 2.0 * growth * (rungs @ rungs[r]) + growth * growth * noise[r]
        reached = np.maximum(worst[r], error)
        better = left & ((reached < worst) | ((reached == worst) & (tie[r] + error < tie)))
        worst[better], tie[better], below[better] = reached[better], tie[r] + error[better], r
    return _as_plan(densities, rungs, d, below, float(np.sqrt(worst[top].max())))


def can_climb(densities: tuple[float, ...]) -> bool:
    """Say whether a density, or a combination of two, goes across the projector once at most."""
    return bool(np.any(_start(_candidates(densities) @ np.array(densities, np.float64))))


def _start(rungs: Floats) -> Mask:
    """Return which rungs need no prediction: their phase is omega times at most 1."""
    return np.asarray((rungs > 0.0) & (rungs <= 1.0 + _ROUNDING))


def _candidates(densities: tuple[float, ...]) -> Floats:
    """Return the rungs to choose from, (rungs, densities): the densities first, then combinations of two."""
    n = len(densities)
    unit = np.eye(n)
    order = sorted(range(n), key=lambda i: densities[i])
    pairs = combinations(order, 2) if n <= _ALL_PAIRS_UP_TO else pairwise(order)
    rungs = [unit[i] for i in range(n)]
    rungs += [unit[high] - unit[low] for low, high in pairs if densities[high] > densities[low]]
    if _start(np.array(rungs) @ np.array(densities, np.float64)).any():
        return np.array(rungs)
    factors = range(1, _LARGEST_FACTOR + 1)
    for (i, j), a, b in product(combinations(range(n), 2), factors, factors):
        if abs(a * densities[i] - b * densities[j]) == 1:
            sign = a * densities[i] - b * densities[j]
            rungs.append(sign * (a * unit[i] - b * unit[j]))
    return np.array(rungs)


def _why_ambiguous(densities: tuple[float, ...]) -> str:
    listed = ", ".join(f"{t:g}" for t in densities)
    shared = gcd(*map(int, densities)) if all(t == int(t) for t in densities) else 1
    if shared > 1:
        return (
            f"fringe densities {listed} share the factor {shared}, so that omega is known only modulo "
            f"2 pi / {shared}: add a density that does not share it"
        )
    return (
        f"fringe densities {listed} cannot be unwrapped: no two of them, taken at most {_LARGEST_FACTOR} "
        "times, differ by one fringe; add the density 1 or a neighbour of one of them"
    )


def _as_plan(
    densities: tuple[float, ...], rungs: Floats, d: Floats, below: Ints, amplification: float
) -> Plan:
    """Keep only the rungs on the way to a density, each after the one below it."""
    order: list[int] = []
    for index in range(len(densities)):
        path = []
        rung = index
        while rung >= 0 and rung not in order:
            path.append(rung)
            rung = int(below[rung])
        order += reversed(path)
    place = {rung: i for i, rung in enumerate(order)}
    first, second, factors = [], [], []
    for rung in order:
        used = np.flatnonzero(rungs[rung])
        first.append(used[0])
        second.append(used[-1])
        factors.append([rungs[rung][used[0]], rungs[rung][used[1]] if used.size > 1 else 0.0])
    return Plan(
        densities,
        np.array(first),
        np.array(second),
        np.array(factors),
        np.array([place[int(below[r])] if below[r] >= 0 else -1 for r in order]),
        d[order],
        np.array([place[i] for i in range(len(densities))]),
        amplification,
    )
