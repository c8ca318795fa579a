"""Lines of pixels that show fringes and a Gray code, and the phase that is followed along them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.phase.gray_code import Numbers
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.phase_stepping import phase_sigma, stepping_weights

_BENDS = (pi / 8.0, pi / 4.0)
"""By which the phase's slope may change from a pixel to the next on what is taken for smooth: what four
standard deviations of the noise ask for, and between these."""
_STEEPEST = 0.75 * pi  # from a pixel to the next: beyond, the way round the circle is not sure
_LIT = 5.0  # standard deviations of noise in the modulation
_LEAST_PIXELS = 200
_SOME = 2000  # pixels, of which the steps are compared with a fringe
_CAP = 9.0  # of a squared misfit in units of its variance, as of other frames (`frame_fit`)
_READ = (
    0.25  # of the lit pixels, at least: of stripes as narrow as a pixel half are in doubt, and half of these
)


@dataclass(frozen=True)
class CodedLines:
    """What fringes of one density and a Gray code show along lines of pixels.

    Attributes
    ----------
    levels
        (steps, pixels): the phase steps of the lowest density, all lines one after the other.
    above, doubt
        (bits, pixels): how far the patterns are above their threshold, the coarsest first, and within which
        distance of it they may be misread; the second of any shape that is broadcast to this.
    starts
        (pixels,): the first pixel of each line.
    density, stripes
        Across the projector.
    offset_rad
        What the patterns add to the phase.
    grey_levels
        What the levels mean.
    accepted_rad
        Phase error of the fringes themselves that is accepted.
    border_rad
        By which borders of the code may lie beside their place, in rad of the fringes.
    """

    levels: NDArray[Any]
    above: Singles
    doubt: Singles
    starts: Mask
    density: float
    stripes: float
    offset_rad: float
    grey_levels: GreyLevels
    accepted_rad: float
    border_rad: float

    @property
    def steps(self) -> int:
        """Number of phase steps."""
        return len(self.levels)

    @property
    def bits(self) -> int:
        """Number of patterns of the code."""
        return len(self.above)

    @cached_property
    def words(self) -> Numbers:
        """(pixels,): the word of the code at each pixel; -1 where a bit is in doubt."""
        word = np.zeros(self.above.shape[1], np.int32)
        for bright in self.above > 0.0:
            word = (word << 1) | bright
        unsure = np.any(np.abs(self.above) < self.doubt, axis=0)
        return np.where(unsure, np.int32(-1), word)


@dataclass(frozen=True)
class SeenPhases:
    """The fringes' phase along lines.

    Attributes
    ----------
    lit
        (pixels,): where fringes are seen and in range.
    phase
        (pixels,): in rad, followed from pixel to pixel along each piece.
    piece
        (pixels,): number of the smooth piece of a line that a pixel is in; every break begins another.
    sigma
        Median standard deviation of a phase, in rad.
    broken
        Part of the pairs of lit neighbours between which the phase is not smooth.
    misfit
        Mean square of what three numbers leave of the steps, in units of noise and of what is accepted; 0 of
        three steps.
    read
        Part of the lit pixels whose bits are all sure.
    """

    lit: Mask
    phase: Floats
    piece: NDArray[np.intp]
    sigma: float
    broken: float
    misfit: float
    read: float

    @property
    def legible(self) -> bool:
        """Whether the code is seen where the fringes are: only pixels on borders are in doubt."""
        return self.read > _READ

    @property
    def enough(self) -> bool:
        """Whether enough pixels are lit to say anything."""
        return int(np.count_nonzero(self.lit)) >= _LEAST_PIXELS

    def fits(self, steps: int) -> bool:
        """Say whether the steps are those of a fringe, and pixels beside each other have phases to match.

        What three numbers leave of q steps has q - 3 degrees of freedom: its mean square is (q - 3) / q in
        units of the noise, and of less with what is accepted; 1 is beyond by six standard deviations of a
        mean over 200 pixels for up to 18 steps. Phases that have nothing in common are no smooth continuation
        of each other in three quarters of the pairs, and depth steps in half of them at most.
        """
        return self.misfit < max(1.0, _misfit_limit(steps)) and self.broken < 0.5


def _misfit_limit(steps: int) -> float:
    free = max(steps - 3, 1)
    return float(free / steps) * (1.0 + 6.0 * sqrt(2.0 / (_LEAST_PIXELS * free)))


def wrapped(phase: NDArray[Any]) -> Floats:
    """Return phases within half a turn of 0, in rad."""
    return np.asarray(phase - 2.0 * pi * np.rint(phase / (2.0 * pi)))


def seen_phases(lines: CodedLines, order: tuple[int, ...] | None = None, turn: int = 1) -> SeenPhases:
    """Return the phase along lines, with steps in another `order`, or running the other way (`turn` -1)."""
    steps, grey = lines.steps, lines.grey_levels
    levels = lines.levels[list(order or range(steps))].astype(np.float32)
    mean = levels.mean(axis=0)
    cosine, sine = stepping_weights(steps).astype(np.float32) @ levels
    sine *= turn
    noise = np.sqrt(grey.variance(mean))
    modulation = np.hypot(cosine, sine)
    lit = (modulation > _LIT * noise) & (levels.max(axis=0) < grey.full_scale)
    some = np.flatnonzero(lit)[:: max(1, np.count_nonzero(lit) // _SOME)]
    misfit = _misfit(
        levels[:, some] - mean[some], cosine[some], turn * sine[some], noise[some], lines.accepted_rad
    )
    sigma = float(np.median(phase_sigma(noise[lit], modulation[lit], steps))) if lit.any() else 0.0
    phase = wrapped(np.arctan2(sine, cosine, dtype=np.float64) - lines.offset_rad)
    ahead = wrapped(np.diff(phase))
    pairs = lit[1:] & lit[:-1] & ~lines.starts[1:]
    # Three phases make a bend, with weights 1, -2 and 1: six variances of one.
    bend = np.abs(wrapped(np.diff(ahead))) > np.clip(4.0 * sqrt(6.0) * sigma, *_BENDS)
    known = pairs[1:] & pairs[:-1]
    crooked, beside = np.zeros(len(pairs), np.bool_), np.zeros(len(pairs), np.bool_)
    for part in (slice(1, None), slice(None, -1)):
        crooked[part] |= bend & known
        beside[part] |= known
    smooth = pairs & beside & ~crooked & (np.abs(ahead) < _STEEPEST)
    triples = np.count_nonzero(known)
    return SeenPhases(
        lit,
        np.concatenate([[0.0], np.cumsum(np.where(smooth, ahead, 0.0))])
        + _begun(phase, np.concatenate([[True], ~smooth]), np.where(smooth, ahead, 0.0)),
        np.concatenate([[0], np.cumsum(~smooth)]),
        sigma,
        float(np.count_nonzero(bend & known) / triples) if triples else 0.0,
        misfit,
        float(np.mean(lines.words[lit] >= 0)) if lit.any() else 0.0,
    )


def _begun(phase: Floats, first: Mask, ahead: Floats) -> Floats:
    """Return what is to be added to the sum of all steps so that every piece begins with its own phase."""
    total = np.concatenate([[0.0], np.cumsum(ahead)])
    place = np.maximum.accumulate(np.where(first, np.arange(len(phase)), 0))
    return np.asarray(phase[place] - total[place])


def _misfit(left: Singles, cosine: Singles, sine: Singles, noise: Singles, accepted_rad: float) -> float:
    """Return the mean square of what the fringe leaves of the steps less their mean, (steps, pixels).

    The second and the third harmonic, one amplitude each for all pixels, are taken out: a projector that is
    not linear is no fault of a frame.
    """
    steps = len(left)
    if steps < 4 or not left.shape[1]:
        return 0.0
    angles = (2.0 * pi * np.arange(steps, dtype=np.float32) / steps)[:, None]
    modulation, start = np.hypot(cosine, sine), np.arctan2(sine, cosine) + angles
    left = left - modulation * np.cos(start)
    for harmonic in (2, 3):
        if 2 * harmonic <= steps:
            wave = modulation * np.cos(harmonic * start)
            left = left - wave * (np.sum(left * wave) / np.sum(wave * wave))
    accepted = accepted_rad * steps / 2.0
    square = np.square(left) / (np.square(noise) + np.square(accepted * modulation))
    return float(np.minimum(square, _CAP).mean())
