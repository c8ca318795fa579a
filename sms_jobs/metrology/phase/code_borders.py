"""Whether fringes and the Gray code beside them belong together: borders of stripes against the phase.

Along a line of pixels the phase goes on by 2 pi t / S from one border of the code's stripes to the next, for
t fringes and S stripes across the projector, and at border K it is 2 pi t (K / S - 1/2). The first tells a
wrong order of the patterns or of the phase steps, and the second a wrong density and a wrong beginning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from math import pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, stdtrit

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.phase.coded_lines import CodedLines, SeenPhases, wrapped
from sms_jobs.metrology.phase.gray_code import Numbers, number_of

FALSE_ALARM = 1e-7
"""Probability of each single test that it refuses frames which are as told."""

_HIDDEN = 0.2
"""Part of the stretches between borders that contradict, at most, though all is as told; see `Verdict`."""
_SUSPICIOUS = 0.01
_NOISE = 3.0  # standard deviations: exceeded in 0.3 % of the stretches, which is nothing beside a fifth
_MOST_OF_A_PLACE = 8

Renumbering = Callable[[Numbers], Numbers]


@dataclass(frozen=True)
class Borders:
    """Places along smooth pieces of lines where the word of the code changes.

    Attributes
    ----------
    phase, reach
        (borders,), rad: half way between the pixels before and behind, and half their distance.
    before, behind
        (borders,): words of the code.
    piece
        (borders,): number of the piece it is in.
    """

    phase: Floats
    reach: Floats
    before: Numbers
    behind: Numbers
    piece: NDArray[np.intp]


@dataclass(frozen=True)
class BorderLine:
    """A line through what borders are off by, over omega at their place.

    Attributes
    ----------
    slope
        In rad per rad of omega: a difference of densities.
    spread, squares, free
        Weighted sum of the squares of omega about its mean, what the line leaves, and its degrees of freedom.
    half_span
        Half the range of omega.
    """

    slope: float = 0.0
    spread: float = 1.0
    squares: float = 0.0
    free: int = 0
    half_span: float = 0.0


def denied(lines: tuple[BorderLine, ...], accepted_rad: float) -> bool:
    """Say whether the slopes of lines, those of all directions, together deny the density that is told.

    By Student's law with the scatter of all, and by more than is accepted at the ends of what is seen.
    """
    free, spread = sum(one.free for one in lines), sum(one.spread for one in lines)
    if free < 1:
        return False
    slope = sum(one.slope * one.spread for one in lines) / spread
    sigma = sqrt(sum(one.squares for one in lines) / free / spread)
    large = abs(slope) * max(one.half_span for one in lines) > accepted_rad
    return large and abs(slope) > -float(stdtrit(free, 0.5 * FALSE_ALARM)) * sigma


@dataclass(frozen=True)
class Verdict:
    """Whether borders lie where the fringes say.

    Attributes
    ----------
    stretches, contradicting
        (bits,), the coarsest first: stretches between successive borders at either of which that bit changes,
        and those that are longer or shorter than the phase says.
    total
        Both numbers of all stretches.
    line
        Through what the borders are off by: its slope is the density that they ask for, less the told one.
    offset_rad, offset_limit
        Of the fringes against the code, in the mean over the borders, and what is accepted of it.
    accepted_rad
        Phase error at the ends of what is seen that is accepted.

    Notes
    -----
    A stretch contradicts where its length differs from what the phase says by more than half a stripe, what
    lies between the pixels of its two borders, and three deviations of the noise. Where all is as told it
    does so only over a depth step that the phase hides, coming out on the same slope within pi / 4 by chance:
    a quarter of all depth steps, and an eighth where there is little noise. Even with such a step in every
    second stretch a fifth of the unbroken ones contradict at most. Frames are doubted where the binomial
    probability of as many is below 1e-7, and, where a single change explains nine tenths of those that
    contradict, if so it is with one in a hundred. The density is
    refused where Student's probability of its slope is below that, with the scatter that the borders have
    about the line, and the phase is off by more than is accepted at the ends of what is seen; the offset in
    the same way.
    """

    stretches: NDArray[np.int64]
    contradicting: NDArray[np.int64]
    total: tuple[int, int]
    line: BorderLine
    offset_rad: float
    offset_limit: float
    accepted_rad: float

    @property
    def density(self) -> float:
        """What borders ask for, less the told density."""
        return self.line.slope

    @property
    def in_order(self) -> bool:
        """Whether the stretches between borders are as long as the phase says, for each bit."""
        return not bool(np.any(_unlikely(self.contradicting, self.stretches)))

    @property
    def suspicious(self) -> bool:
        """Whether more contradict than one in a hundred: what explains nearly all is then believed."""
        count, wrong = (np.array([one]) for one in self.total)
        return bool(_unlikely(wrong, count, _SUSPICIOUS)[0])

    @property
    def mostly(self) -> bool:
        """Whether half of all stretches are: with fewer than two and a half depth steps in each it is so."""
        count, wrong = self.total
        return 2 * wrong <= count

    @property
    def dense(self) -> bool:
        """Whether the density is the one that is told."""
        return not denied((self.line,), self.accepted_rad)

    @property
    def beside(self) -> bool:
        """Whether the fringes lie beside the code."""
        return abs(self.offset_rad) > self.offset_limit

    @property
    def agrees(self) -> bool:
        """Whether fringes and code belong together."""
        return self.in_order and not self.suspicious and self.dense and not self.beside


def _unlikely(many: NDArray[np.int64], of: NDArray[np.int64], share: float = _HIDDEN) -> Any:
    """Say where so many contradictions are too many, with that share of them to be expected."""
    return (many > 0) & (bdtrc(np.maximum(many - 1, 0), of, share) < FALSE_ALARM)


def borders_of(lines: CodedLines, seen: SeenPhases) -> Borders:
    """Return where the word of the code changes along smooth pieces; doubtful pixels are stepped over."""
    sure = np.flatnonzero((lines.words >= 0) & seen.lit)
    one, other = sure[:-1], sure[1:]
    changed = (lines.words[one] != lines.words[other]) & (seen.piece[one] == seen.piece[other])
    one, other = one[changed], other[changed]
    return Borders(
        0.5 * (seen.phase[one] + seen.phase[other]),
        0.5 * np.abs(seen.phase[other] - seen.phase[one]),
        lines.words[one],
        lines.words[other],
        seen.piece[one],
    )


def judged(
    borders: Borders,
    lines: CodedLines,
    sigma: float,
    *,
    density: float | None = None,
    number: Renumbering = number_of,
    free: int = 0,
) -> Verdict:
    """Say whether borders lie where fringes of a density say, with words that mean stripes by `number`.

    `free` is a bit of the words, as a number, that may be either at every border.
    """
    t, stripes, bits = density or lines.density, lines.stripes, lines.bits
    stripe_rad = 2.0 * pi * t / stripes
    choices = [
        0.5 * (number(borders.before ^ bit) + number(borders.behind ^ bit) + 1) for bit in sorted({0, free})
    ]
    place = choices[0]
    reach = np.minimum(borders.reach, 0.5 * stripe_rad)
    one = np.flatnonzero(borders.piece[1:] == borders.piece[:-1])
    limit = 0.5 * stripe_rad + reach[one] + reach[one + 1] + _NOISE * sigma * np.sqrt(2.0)
    wrong = np.ones(len(one), np.bool_)
    for here, there in product(choices, choices):
        length = (there[one + 1] - here[one]) * stripe_rad
        wrong &= np.abs(length - np.diff(borders.phase)[one]) > limit
    flips = borders.before ^ borders.behind
    touched = flips[one] | flips[one + 1]
    each = (touched[:, None] >> np.arange(bits - 1, -1, -1)) & 1 == 1
    used = np.zeros(len(place), np.bool_)
    used[one[~wrong]] = used[one[~wrong] + 1] = True
    off = wrapped(borders.phase[used] - stripe_rad * (place[used] - 0.5 * stripes))
    line, offset = _line(place[used], off, t, stripes)
    return Verdict(
        each.sum(axis=0),
        (each & wrong[:, None]).sum(axis=0),
        (len(one), int(wrong.sum())),
        line,
        offset[0],
        max(offset[1], lines.border_rad),
        lines.accepted_rad,
    )


def _line(
    place: NDArray[Any], off: Floats, density: float, stripes: float
) -> tuple[BorderLine, tuple[float, float]]:
    """Fit offset and slope to what borders are off by, in rad, modulo a turn.

    Borders of one place count as one, for what displaces one of them displaces all; the weight grows up to
    eight of them. Returns the line, and the offset at its middle with its limit.
    """
    places, which, count = np.unique(place, return_inverse=True, return_counts=True)
    if places.size < 3:
        return BorderLine(), (0.0, np.inf)
    sums = np.zeros(places.size, np.complex128)
    np.add.at(sums, which, np.exp(1j * off))
    weight = np.minimum(count, _MOST_OF_A_PLACE).astype(np.float64)
    mean = sums / np.maximum(np.abs(sums), np.finfo(np.float64).tiny)
    x = 2.0 * pi * (places / stripes - 0.5)
    x -= np.average(x, weights=weight)
    # The slope is found modulo turns first: where all borders are turned back together most.
    slopes = np.arange(0.0, 0.5 * density, 0.5 * pi / float(np.ptp(x)))
    slopes = np.concatenate([-slopes[:0:-1], slopes])
    together = np.sum(np.exp(-1j * np.outer(slopes, x)) * (weight * mean), axis=1)
    start = slopes[np.argmax(np.abs(together))]
    turned = mean * np.exp(-1j * start * x)
    middle = float(np.angle(np.sum(weight * turned)))
    left = np.angle(turned * np.exp(-1j * middle))
    middle += float(np.average(left, weights=weight))
    left -= np.average(left, weights=weight)
    spread, free = float(np.sum(weight * x * x)), places.size - 2
    more = float(np.sum(weight * x * left)) / spread
    squares = float(np.sum(weight * np.square(left - more * x)))
    line = BorderLine(float(start + more), spread, squares, free, 0.5 * float(np.ptp(x)))
    sigma = sqrt(squares / free / float(weight.sum()))
    beside = middle - 2.0 * pi * float(np.rint(middle / (2.0 * pi)))
    return line, (beside, -float(stdtrit(free, 0.5 * FALSE_ALARM)) * sigma)
