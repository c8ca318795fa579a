"""Whether frames that share one mean and one modulation show what is stated of them, and which does not.

As in `frame_mishaps` each explanation changes one thing, and is tried on a sample of the pixels; frames of
the anchor cannot be left out, for without them nothing tells mean and modulation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.images.masks import phase_error_factor
from sms_jobs.metrology.phase.frame_mishaps import Mishap
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.joint_fit import JointCode, fit_jointly, with_transfer
from sms_jobs.metrology.phase.phase_stepping import phase_sigma

_KEPT = 0.999
_AGREE = 0.5  # of the lit pixels agree, or something is wrong
_EXPLAINED = 0.6
_NEAR = (-3, -2, -1, 1, 2, 3)  # numbers of fringes beside those told
_TRIED = 600  # pixels


@dataclass(frozen=True)
class JointFrames:
    """Frames of one orientation at some pixels, and what they are said to show.

    Attributes
    ----------
    levels
        (frames, pixels), grey levels of the camera's own type.
    code
        What they are said to show.
    grey_levels
        What they mean.
    accepted_rad
        Phase error of the fringes themselves that is accepted.
    """

    levels: NDArray[Any]
    code: JointCode
    grey_levels: GreyLevels
    accepted_rad: float

    def with_own_transfer(self) -> JointFrames:
        """Return them with the transfer that they show themselves, as the code is told now."""
        plain = replace(self.code, transfer=np.ones(len(self.code.densities)))
        return replace(self, code=with_transfer(self.levels[:, None, :], plain, self.grey_levels))

    def share(self) -> float:
        """Return the part of the pixels whose frames belong to one mean, modulation and phase gradient."""
        found = fit_jointly(self.levels[:, None, :], self.code, self.grey_levels)
        with np.errstate(divide="ignore", invalid="ignore"):
            noise = np.sqrt(self.grey_levels.variance(found.mean_intensity))
            sigma = phase_sigma(noise, found.modulation, self.code.steps)
        limit = np.hypot(phase_error_factor(self.code.freedom + 1, _KEPT) * sigma, self.accepted_rad)
        return float(np.mean(found.phase_error < limit))


def find_joint_mishap(told: JointFrames) -> Mishap | None:
    """Find what is wrong with frames that do not agree; None where no single change explains them.

    Frames are counted within the orientation.
    """
    step = max(1, told.levels.shape[1] // _TRIED)
    thin = replace(told, levels=np.ascontiguousarray(told.levels[:, ::step]))
    best, most = None, _EXPLAINED
    for mishap, changed in _explanations(thin):
        now = changed.with_own_transfer().share()
        if now > most:
            best, most = mishap, now
    return best


def agrees(share: float) -> bool:
    """Say whether so many of the lit pixels agree that nothing has to be wrong."""
    return share >= _AGREE


def _explanations(told: JointFrames) -> Iterator[tuple[Mishap, JointFrames]]:
    """Yield what may be wrong, and the frames with that repaired."""
    code, levels = told.code, told.levels
    count = len(levels)
    for f, g in combinations(range(count), 2):
        swapped = levels.copy()
        swapped[[f, g]] = levels[[g, f]]
        yield Mishap("exchanged", (f, g)), replace(told, levels=swapped)
    first, last, _ = code.anchor.indices(count)
    for f in (f for f in range(count) if not first <= f < last):
        left = np.delete(np.arange(count), f)
        try:
            before = int(f < first)
            rest = (one[left] for one in (code.densities, code.turns, code.transfer))
            densities, turns, transfer = rest
            shorter = JointCode(densities, turns, slice(first - before, last - before), transfer)
        except InvalidInput:  # too few frames to tell
            continue
        yield Mishap("other", (f,)), replace(told, code=shorter, levels=levels[left])
    for density in dict.fromkeys(code.densities.tolist()):
        for other in (density + apart for apart in _NEAR if density + apart >= 1.0):
            changed = np.where(code.densities == density, other, code.densities)
            yield (
                Mishap("count", stated=density, actual=other),
                replace(told, code=replace(code, densities=changed)),
            )
