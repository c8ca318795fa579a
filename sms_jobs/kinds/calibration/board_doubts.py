"""What speaks against the boards of a session once all is adjusted: images twice, residuals too large."""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations

import numpy as np

from sms_jobs.metrology.calibration.bundle.problem import BoardPoints, BundleProblem, ResidualType
from sms_jobs.metrology.calibration.bundle.result import Adjustment

_MOST_WHITENED = 3.0
"""Rms of residuals over their stated deviation: more is no noise, and parameters are worse than stated."""

_MOST_RADIAL = 0.1
"""Share of squared residuals that one radial term more may take: with it, they are 5 % less."""

_LEAST_RADIAL_PX = 0.01
"""What that term is worth at least, rms, to be spoken of: simulated images tell a thousandth of it."""

_ALIKE = 0.5
"""Of the difference that noise makes between two pictures of a board that stood still."""


def board_doubts(problem: BundleProblem, found: Adjustment) -> tuple[str, ...]:
    """Return what a person has to look at of the boards."""
    return (*_repeated(problem, found), *_misfit(found), *_bent(found))


def _misfit(found: Adjustment) -> list[str]:
    """Name sensors whose points lie farther off than what is stated of them explains."""
    return [
        f"the points of boards lie {one.rms:.3g} px rms from where the calibration has them in {one.name}, "
        f"{one.whitened:.1f} times the deviation that is stated of them (limit {_MOST_WHITENED:g}): the "
        "lens, the board or which image belongs to which pose is not as told; look at the maps of residuals"
        for one in found.rms
        if one.of == "sensor" and one.type.of_board and one.whitened > _MOST_WHITENED
    ]


def _bent(found: Adjustment) -> list[str]:
    """Name plain lenses whose residuals are those of another one."""
    rms = {one.name: one.rms for one in found.rms if one.of == "sensor" and one.type.of_board}
    return [
        f"the residuals of boards in {name} grow outwards as those of another lens do: one radial term more "
        f"would take {share:.0%} of their squares (limit {_MOST_RADIAL:.0%}), {share**0.5 * rms[name]:.2g} "
        "px rms; free k3 (fixed=none), or calibrate with lens=rational, or lens=fisheye for more than about "
        "90 degrees across"
        for name, share in found.missing_radial.items()
        if share > _MOST_RADIAL and share**0.5 * rms[name] > _LEAST_RADIAL_PX
    ]


def _repeated(problem: BundleProblem, found: Adjustment) -> list[str]:
    """Name poses that show a sensor the same, to less than the noise of two pictures."""
    seen: dict[int, list[BoardPoints]] = defaultdict(list)
    for item in problem.board_points:
        seen[item.sensor].append(item)
    alike: dict[tuple[int, int], list[int]] = defaultdict(list)
    shown: dict[int, set[int]] = defaultdict(set)
    for sensor, items in seen.items():
        factor = found.variance_factors.get(ResidualType.of_board_in(items[0].projector), 1.0)
        for item in items:
            shown[item.pose].add(sensor)
        for first, other in combinations(items, 2):
            if _same(first, other, factor):
                alike[first.pose, other.pose].append(sensor)
    doubts = []
    for (a, b), sensors in alike.items():
        one, two = (problem.board_poses[k].name for k in (a, b))
        names = " and ".join(problem.sensors[s].name for s in sensors)
        if set(sensors) == shown[a] & shown[b]:
            doubts.append(
                f"poses {one} and {two} are one picture, or the board stood still: {names} saw every point "
                "within the noise of one; leave one of them out, it tells nothing new"
            )
        else:
            doubts.append(
                f"{names} has the same picture in poses {one} and {two}, other sensors do not: one of them "
                "belongs to another pose; import it again"
            )
    return doubts


def _same(first: BoardPoints, other: BoardPoints, factor: float) -> bool:
    """Say whether two views show the points that they share at the same pixels."""
    if abs(len(first.point) - len(other.point)) > 0.2 * len(first.point):
        return False
    places = [{(x, y): k for k, (x, y) in enumerate(p.point[:, :2].tolist())} for p in (first, other)]
    shared = [key for key in places[0] if key in places[1]]
    if len(shared) < 0.8 * len(first.point):
        return False
    a = first.pixel[[places[0][key] for key in shared]]
    b = other.pixel[[places[1][key] for key in shared]]
    noise = factor * float(np.sqrt(np.mean(first.sigma_px**2) + np.mean(other.sigma_px**2)))
    return bool(np.sqrt(np.mean((a - b) ** 2)) < _ALIKE * noise)
