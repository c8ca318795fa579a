"""Tables of poses for a pan-tilt stage (thesis 3.2.2, Tables 2 and 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import degrees, inf, log, pi
from typing import Literal

import numpy as np

from sms_jobs.errors import InvalidInput

_ELONGATED = 3.0  # at most so many times finer along one axis than along the other


@dataclass(frozen=True)
class StagePose:
    """Where a stage is brought, in rad."""

    pan_rad: float
    tilt_rad: float


@dataclass(frozen=True)
class AngleRange:
    """A range of angles, in rad."""

    minimum_rad: float
    maximum_rad: float

    @property
    def turn(self) -> bool:
        """Whether it is a full turn, whose ends are the same place."""
        return self.width_rad > 2.0 * pi - 1e-9

    @property
    def width_rad(self) -> float:
        """From end to end."""
        return self.maximum_rad - self.minimum_rad

    def divided(self, count: int) -> tuple[float, ...]:
        """Return `count` angles that divide it evenly, both ends included unless they are the same place."""
        if count == 1:
            return (0.5 * (self.minimum_rad + self.maximum_rad),)
        step = self.width_rad / (count if self.turn else count - 1)
        return tuple(self.minimum_rad + k * step for k in range(count))


def uniform_poses(
    count: int,
    pan: AngleRange,
    tilt: AngleRange,
    order: Literal["serpentine", "random"] = "serpentine",
    seed: int = 0,
) -> tuple[StagePose, ...]:
    """Return poses that divide both ranges evenly.

    Parameters
    ----------
    count
        Of poses; it must be a product of two numbers that suit the ranges.
    pan, tilt
        The valid ranges.
    order
        A serpentine along the axis that makes the whole way shortest, or an order drawn from `seed`.

    Raises
    ------
    InvalidInput
        The number cannot be divided so; the message names two that can.
    """
    pans, tilts = (r.divided(n) for r, n in zip((pan, tilt), _grid(count, pan, tilt), strict=True))
    poses = _serpentine(pans, tilts)
    if order == "random":
        generator = np.random.default_rng(seed)
        poses = tuple(poses[k] for k in generator.permutation(len(poses)))
    return poses


def travel(poses: Sequence[StagePose]) -> float:
    """Return the whole way of both axes from pose to pose, in rad."""
    return sum(abs(b.pan_rad - a.pan_rad) + abs(b.tilt_rad - a.tilt_rad) for a, b in pairwise(poses))


def _serpentine(pans: Sequence[float], tilts: Sequence[float]) -> tuple[StagePose, ...]:
    along_pan = tuple(
        StagePose(pan, tilt)
        for k, tilt in enumerate(tilts)
        for pan in (pans if k % 2 == 0 else tuple(reversed(pans)))
    )
    along_tilt = tuple(
        StagePose(pan, tilt)
        for k, pan in enumerate(pans)
        for tilt in (tilts if k % 2 == 0 else tuple(reversed(tilts)))
    )
    # A hair's breadth, so that rounding does not decide between equal ways.
    return along_tilt if travel(along_tilt) < travel(along_pan) * (1.0 - 1e-9) else along_pan


def _grid(count: int, pan: AngleRange, tilt: AngleRange) -> tuple[int, int]:
    """Return how many values of pan and tilt make the spacings most alike."""
    if count < 1 or min(pan.width_rad, tilt.width_rad) <= 0.0:
        raise InvalidInput(
            f"{count} poses over {degrees(pan.width_rad):.4g} by {degrees(tilt.width_rad):.4g} degrees "
            "cannot be: at least one pose and two ranges that are not empty are needed"
        )
    if count == 1:
        return 1, 1
    stretch, grid = _best(count, pan, tilt)
    if grid is None or stretch > log(_ELONGATED):
        near = sorted(range(2, 2 * count + 4), key=lambda n: (abs(n - count), n))
        fitting = [n for n in near if _best(n, pan, tilt)[0] <= log(_ELONGATED)]
        raise InvalidInput(
            f"{count} poses do not divide {degrees(pan.width_rad):.4g} by {degrees(tilt.width_rad):.4g} "
            f"degrees evenly: ask for {' or '.join(str(n) for n in sorted(fitting[:2]))}"
        )
    return grid


def _best(count: int, pan: AngleRange, tilt: AngleRange) -> tuple[float, tuple[int, int] | None]:
    best: tuple[float, tuple[int, int] | None] = (inf, None)
    for pans in range(2, count // 2 + 1):
        if count % pans:
            continue
        grid = (pans, count // pans)
        spacings = [r.width_rad / (n if r.turn else n - 1) for r, n in zip((pan, tilt), grid, strict=True)]
        stretch = abs(log(spacings[0] / spacings[1]))
        if stretch < best[0] - 1e-9:
            best = (stretch, grid)
    return best
