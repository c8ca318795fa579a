"""What the frames of an unknown recording show: runs of phase steps, and two-level patterns between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.phase.phase_stepping import stepping_weights

MOST_STEPS = 24
_PIXELS = 3000
_LIT = 0.2  # of the largest range over the frames
_BETWEEN = 0.22  # of the pixels: a sixth lie there on stripes of three pixels, a third on fringes
_FITS = 0.15  # of the modulation: what departures of true runs stay below


@dataclass(frozen=True)
class FrameOrder:
    """What frames show, in order.

    Attributes
    ----------
    fringes
        (frames,): whether a frame belongs to a run of phase steps; the others are Gray code, white or black.
    steps
        Phase steps of a run; 0 where no frames form one.
    uncertain
        Whether the others are not of two levels, as code, white and black are.
    """

    fringes: NDArray[np.bool_]
    steps: int
    uncertain: bool = False

    @property
    def runs(self) -> int:
        """How many runs of phase steps there are."""
        return int(self.fringes.sum()) // self.steps if self.steps else 0


def frame_order(frames: NDArray[Any]) -> FrameOrder:
    """Tell fringes from other patterns, and find the number of phase steps.

    Parameters
    ----------
    frames
        (frames, pixels): a sample of the pixels, in order of recording.

    Notes
    -----
    The frames of a run of q steps are a sinusoid over the step, and runs that follow each other have one
    mean, whatever their densities. A wrong q breaks one of the two: with too few steps the means differ, with
    too many the sinusoid does not fit. The q whose runs cover most frames is taken, the smallest of equals. A
    single run of three steps, which nothing contradicts, has to be all that there is.
    """
    levels = np.asarray(frames, np.float64)
    span = levels.max(axis=0) - levels.min(axis=0)
    lit = np.flatnonzero(span > _LIT * span.max(initial=0.0))
    lit = lit[:: max(1, lit.size // _PIXELS)]
    levels = levels[:, lit]
    best, covered = 0, np.zeros(len(levels), np.bool_)
    for steps in range(3, min(MOST_STEPS, len(levels)) + 1 if lit.size else 0):
        found = _covered(levels, steps)
        if found.sum() > covered.sum():
            best, covered = steps, found
    return FrameOrder(covered, best, _of_many_levels(levels, ~covered))


def _of_many_levels(levels: NDArray[np.float64], others: NDArray[np.bool_]) -> bool:
    """Say whether frames have more than two levels: pixels half way between their darkest and brightest.

    Of a sinusoid a third of them are nearer to the middle than to either end; of stripes those on borders.
    """
    if not others.any() or not levels.shape[1]:
        return False
    low, high = levels.min(axis=0), levels.max(axis=0)
    between = (levels[others] - low) / np.maximum(high - low, 1.0)
    return float(np.mean(np.abs(between - 0.5) < 0.25)) > _BETWEEN


def _covered(levels: NDArray[np.float64], steps: int) -> NDArray[np.bool_]:
    """Return which frames belong to runs of that many steps."""
    covered = np.zeros(len(levels), np.bool_)
    start = 0
    while start + steps <= len(levels):
        runs = 0
        while (stop := start + (runs + 1) * steps) <= len(levels) and _fits(levels[start:stop], steps):
            runs += 1
        if steps == 3 and runs == 1 and len(levels) > 3:
            runs = 0
        covered[start : start + runs * steps] = True
        start += max(runs * steps, 1)
    return covered


def _fits(levels: NDArray[np.float64], steps: int) -> bool:
    return _misfit(levels, steps) < _FITS


def _misfit(fringes: NDArray[np.float64], steps: int) -> float:
    """Return how far frames are from runs of that many steps, in units of their modulation."""
    runs = fringes.reshape(-1, steps, fringes.shape[1])
    mean = runs.mean(axis=1)
    cosine, sine = (np.einsum("k,rkp->rp", w, runs) for w in stepping_weights(steps))
    modulation = np.sqrt(np.mean(cosine**2 + sine**2))
    if modulation == 0.0:
        return np.inf
    apart = np.sqrt(np.mean((mean - mean.mean(axis=0)) ** 2)) if len(runs) > 1 else 0.0
    angles = 2.0 * np.pi * np.arange(steps)[None, :, None] / steps
    fit = mean[:, None] + cosine[:, None] * np.cos(angles) - sine[:, None] * np.sin(angles)
    left = np.sqrt(np.mean((runs - fit) ** 2) * steps / max(steps - 3, 1))
    return float(np.hypot(apart, left) / modulation)
