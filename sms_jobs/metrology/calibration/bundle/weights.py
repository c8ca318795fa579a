"""Robust weights of a bundle adjustment, and the variance of each residual type.

An observation is a pair of whitened residuals: a ray gap with the surface residual that it does not explain,
or both coordinates of a board point. Its distance d is the length of the pair, each divided by the variance
factor of its type; it weighs min(1, k / d) (Huber 1981, in two dimensions).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, exp, isfinite, pi, sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.bundle.normal_equations import Live, Observed, Packed

_LEAST_SCALE = 1e-3
"""Variance factors stay above it: residuals a thousandth of what is stated are rounding, not noise."""

_FEWEST = 20
"""Residuals of a type from which its variance can be estimated."""

_PASSES = 4


@dataclass(frozen=True)
class Consistency:
    """What a Huber weight of constant k does to pairs of normal residuals.

    Attributes
    ----------
    weight
        E[w].
    power
        E[w^2 d^2] / 2: the variance that clipped residuals seem to have.
    slope
        E[w + w' d / 2]: how steeply a clipped residual follows its argument.
    """

    weight: float
    power: float
    slope: float

    @classmethod
    def of(cls, huber: float) -> Consistency:
        """Return the expectations over d, whose density is d exp(-d^2 / 2)."""
        if not isfinite(huber):
            return cls(1.0, 1.0, 1.0)
        tail = exp(-0.5 * huber * huber)
        beyond = huber * sqrt(0.5 * pi) * erfc(huber / sqrt(2.0))  # E[k / d; d > k]
        # Beyond k, w + w' d / 2 = k / (2 d); within it is 1.
        return cls(1.0 - tail + beyond, 1.0 - tail, 1.0 - tail + 0.5 * beyond)

    @property
    def correction(self) -> float:
        """Return what the weighted normal matrix is multiplied by for its inverse to be the covariance."""
        return self.slope * self.slope / (self.weight * self.power)


def distances(observed: Observed, packed: Packed, scale: Floats) -> tuple[Floats, Floats]:
    """Return the distance of every observation, (n,) of bars and (m,) of boards; NaN without a residual."""
    bar = np.hypot(observed.bar_found[:, 0] / scale[0], observed.bar_found[:, 1] / scale[1])
    of_type = np.where(projected(packed), scale[3], scale[2])
    return bar, np.hypot(observed.board_found[:, 2], observed.board_found[:, 3]) / of_type


def projected(packed: Packed) -> Mask:
    """Return which board points a projector saw, (m,)."""
    flags = np.zeros(len(packed.board_observed), np.bool_)
    for block in packed.boards:
        flags[block.start : block.stop] = block.projector
    return flags


def cost(observed: Observed, packed: Packed, live: Live, scale: Floats, huber: float) -> float:
    """Return the robust cost of all observations with the whitening that they have."""
    total = 0.0
    for distance, part in zip(distances(observed, packed, scale), (live.bar, live.board), strict=True):
        d = distance[part]
        clipped = np.minimum(d, huber) if isfinite(huber) else d
        total += float(np.sum(clipped * (d - 0.5 * clipped)))
    return total


def _squares(
    observed: Observed, packed: Packed, live: Live, scale: Floats, huber: float
) -> tuple[Floats, Floats]:
    """Return the sum of squared clipped residuals of each type, (4,), and their number, (4,)."""
    bar, board = distances(observed, packed, scale)
    with np.errstate(invalid="ignore", divide="ignore"):
        bar_weight = np.minimum(1.0, huber / bar) ** 2 if isfinite(huber) else np.ones_like(bar)
        board_weight = np.minimum(1.0, huber / board) ** 2 if isfinite(huber) else np.ones_like(board)
    by_projector = projected(packed)
    total, count = np.zeros(4), np.zeros(4)
    for kind in (0, 1):
        total[kind] = np.sum((bar_weight * observed.bar_found[:, kind] ** 2)[live.bar])
        count[kind] = live.bar.sum()
    both = board_weight * np.sum(observed.board_found[:, 2:4] ** 2, axis=1)
    for kind, chosen in ((2, ~by_projector & live.board), (3, by_projector & live.board)):
        total[kind], count[kind] = np.sum(both[chosen]), 2.0 * chosen.sum()
    return total, count


def first_scale(observed: Observed, packed: Packed, live: Live) -> Floats:
    """Return variance factors (4,) from the median of the residuals, which outliers leave alone."""
    by_projector = projected(packed)
    scale = np.ones(4)
    parts = [observed.bar_found[live.bar, 0], observed.bar_found[live.bar, 1]]
    parts += [
        observed.board_found[chosen & live.board, 2:4].ravel() for chosen in (~by_projector, by_projector)
    ]
    for kind, part in enumerate(parts):
        if len(part) >= _FEWEST:
            scale[kind] = max(float(np.median(np.abs(part))) / 0.6745, _LEAST_SCALE)
    return scale


def estimate_scale(
    observed: Observed,
    packed: Packed,
    live: Live,
    scale: Floats,
    absorbed: Floats,
    huber: float,
) -> Floats:
    """Return variance factors (4,): mean clipped square over its expectation, less what the fit absorbed.

    Parameters
    ----------
    scale
        From which the iteration starts.
    absorbed
        (4,) trace(N_k N^-1): how many residuals of each type the parameters took up (Forstner 1979).

    Notes
    -----
    Huber's proposal 2 with Forstner's redundancies. Types with fewer than 20 residuals keep 1.
    """
    power = Consistency.of(huber).power
    for _ in range(_PASSES if isfinite(huber) else 1):
        total, count = _squares(observed, packed, live, scale, huber)
        share = power * count - absorbed
        enough = (count >= _FEWEST) & (share > 0.05 * count)
        found = np.sqrt(total / np.where(enough, share, 1.0))
        scale = np.where(enough, np.maximum(found, _LEAST_SCALE), 1.0)
    return np.asarray(scale)
