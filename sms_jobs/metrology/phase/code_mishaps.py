"""What is wrong with fringes and a Gray code that do not belong together.

Each explanation changes one thing - the order of two patterns or of two phase steps, an inverted pattern, a
density, the fringes of another direction - and counts if fringes and code agree with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from math import pi, sqrt
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Singles
from sms_jobs.metrology.phase.code_borders import Borders, Renumbering, Verdict, borders_of, judged
from sms_jobs.metrology.phase.coded_lines import CodedLines, SeenPhases, seen_phases
from sms_jobs.metrology.phase.gray_code import explanations, number_of
from sms_jobs.metrology.phase.grey_levels import GreyLevels

What = Literal["density", "reversed", "patterns", "exchanged", "frame", "fringes", "pattern", "beside"]

_LESS = 0.1
_MANY, _FEW = 20, 0.1  # stretches that have to agree for one more change, and those that need not
_MOST_STEPS = 24  # of which every two are exchanged
_VARIES = (
    0.05  # of the lit pixels are bright, and as many dark, in a pattern that changes within what is seen
)
_ALIKE = 0.25  # of the difference that two frames should have
_TELLING = 2.0  # times the variance of noise in the difference that two frames should have, at least


@dataclass(frozen=True)
class CodeMishap:
    """What may be wrong with the fringes or the code of an orientation.

    Attributes
    ----------
    what
        A wrong density; steps that run the other way; patterns, said in `text`; two phase steps that have
        changed places; a phase step that is not shown; the fringes of another orientation; a pattern that is
        not shown; fringes that lie beside the code.
    frames
        The steps, counted within the density, or the bit.
    actual
        The density, or by how many rad the fringes lie beside the code.
    text
        Of patterns: what is wrong with them.
    """

    what: What
    frames: tuple[int, ...] = ()
    actual: float = 0.0
    text: str = ""

    @property
    def sure(self) -> bool:
        """Whether it cannot be motion: fringes beside a code, or no whole number of them, may be."""
        return self.what != "beside" and (self.what != "density" or self.actual == round(self.actual))

    @property
    def of_all(self) -> bool:
        """Whether it is a word about the whole recording, so that every orientation shows it."""
        orders = ("order", "plain binary")
        return self.what in ("density", "reversed", "beside") or any(one in self.text for one in orders)


@dataclass(frozen=True)
class Judgement:
    """What is found of the fringes and the code of one orientation.

    Attributes
    ----------
    seen
        The phases along the lines.
    verdict
        Of fringes and code; None where too little is lit.
    """

    seen: SeenPhases
    verdict: Verdict | None

    @property
    def telling(self) -> bool:
        """Whether many stretches between borders agree, and hardly one does not."""
        count, wrong = (0, 0) if self.verdict is None else self.verdict.total
        return count >= _MANY and wrong <= _FEW * count

    def agrees(self, steps: int) -> bool:
        """Say whether nothing contradicts what is told, or too little is lit to say anything."""
        if self.verdict is None:
            return True
        return self.seen.fits(steps) and self.seen.legible and self.verdict.agrees

    def denies(self, steps: int) -> bool:
        """Say whether frames are to be refused though nothing explains what is wrong with them.

        Where stretches contradict at the borders of some bits alone they are not: a single pattern that is
        wrong turns the stripes of all finer ones round, so that half of all contradict, and depth steps may
        be many.
        """
        if self.verdict is None:
            return False
        ordered = self.verdict.in_order or self.verdict.mostly
        sound = ordered and self.verdict.dense and not self.verdict.beside
        return not (self.seen.fits(steps) and self.seen.legible and sound)


def judge(lines: CodedLines, order: tuple[int, ...] | None = None, turn: int = 1) -> Judgement:
    """Judge fringes and code of an orientation, with the steps in another order or running the other way."""
    seen = seen_phases(lines, order, turn)
    if not seen.enough:
        return Judgement(seen, None)
    return Judgement(seen, judged(borders_of(lines, seen), lines, seen.sigma))


def find_code_mishaps(
    lines: CodedLines, found: Judgement, others: tuple[CodedLines, ...]
) -> list[CodeMishap]:
    """Return what may be wrong where `found` does not agree, each by itself; nothing if nothing explains it.

    `others` have the same code with the fringes of another orientation each. Of several explanations those
    stay that are contradicted by about as few stretches as the best; words about all directions come first.
    """
    steps = lines.steps
    if not found.seen.fits(steps):
        return _best(_exchanged(lines)) or _best(_not_shown(lines))
    if found.verdict is None or not found.seen.legible:
        return []
    borders, verdict = borders_of(lines, found.seen), found.verdict
    beside = [CodeMishap("beside", actual=verdict.offset_rad)] if verdict.beside else []
    at_other_places = beside if verdict.dense else _best(list(_density(lines, borders, found)))
    if verdict.in_order and not verdict.suspicious:
        # Stripes follow each other as they should: what is left is where they lie.
        return at_other_places
    each = [*_patterns(lines, borders, found), *_density(lines, borders, found), *_exchanged(lines)]
    each += _if_agrees(CodeMishap("reversed"), judge(lines, turn=-1), steps)
    for one in others:
        each += _if_agrees(CodeMishap("fringes"), judge(one), steps)
    each = [(mishap, wrong) for mishap, wrong in each if wrong <= _left(verdict)]
    best = sorted(_best(each), key=lambda mishap: not mishap.of_all)
    bits = [] if best else _not_legible(lines, borders, found)
    return (
        best
        or [CodeMishap("pattern", (bit,)) for bit in bits]
        or (at_other_places if verdict.in_order else [])
    )


def _left(verdict: Verdict) -> float:
    """Return how many stretches may contradict what explains it.

    Half of those that contradict what is told, and a tenth where these may be depth steps.
    """
    return verdict.total[1] * (_LESS if verdict.in_order else 0.5)


Explained = list[tuple[CodeMishap, int]]
"""Explanations, and how many stretches between borders contradict each."""


def _best(each: Explained) -> list[CodeMishap]:
    """Return the explanations that are contradicted least, but for chance."""
    least = min((wrong for _, wrong in each), default=0)
    return [mishap for mishap, wrong in each if wrong <= least + 3.0 * sqrt(least)]


def _if_agrees(mishap: CodeMishap, found: Judgement, steps: int) -> Explained:
    if found.verdict is None or not found.agrees(steps):
        return []
    return [(mishap, found.verdict.total[1])]


def _patterns(lines: CodedLines, borders: Borders, found: Judgement) -> Iterator[tuple[CodeMishap, int]]:
    """Yield patterns that are in another order or inverted."""
    plain: tuple[str, Renumbering] = (
        "the patterns are a plain binary code, not a Gray code",
        lambda word: word,
    )
    changed = [(text, _then_numbered(change)) for text, change in explanations(lines.bits)]
    for text, number in [*changed, plain]:
        now = judged(borders, lines, found.seen.sigma, number=number)
        if now.agrees:
            yield CodeMishap("patterns", text=text), now.total[1]


def _density(lines: CodedLines, borders: Borders, found: Judgement) -> Iterator[tuple[CodeMishap, int]]:
    """Yield the density that borders ask for, if it is another than the told one.

    Fringes that begin at the projector's edge lie elsewhere with another density: the offset does not count.
    """
    assert found.verdict is not None
    for density in _densities(lines, borders, found.verdict):
        now = judged(borders, lines, found.seen.sigma, density=density)
        if density != lines.density and now.in_order and now.dense:
            yield CodeMishap("density", actual=density), now.total[1]
            return


def _then_numbered(change: Renumbering) -> Renumbering:
    return lambda word: number_of(change(word))


def _densities(lines: CodedLines, borders: Borders, verdict: Verdict) -> list[float]:
    """Return densities that may have been shown: whole numbers first, then what is measured."""
    measured = [lines.density + verdict.density] if verdict.in_order else []
    one = np.flatnonzero(borders.piece[1:] == borders.piece[:-1])
    place = 0.5 * (number_of(borders.before) + number_of(borders.behind) + 1)
    turns = np.diff(borders.phase)[one] / (2.0 * pi)
    stripes = np.diff(place)[one] / lines.stripes
    moved = stripes != 0.0
    if moved.any():
        measured.append(float(np.median(turns[moved] / stripes[moved])))
    whole = [float(round(t)) for t in measured]
    near = [t + step for t in whole for step in (0.0, -1.0, 1.0) if t + step >= 1.0]
    return [*near, *(round(t, 2) for t in measured if t >= 1.0)]


def _exchanged(lines: CodedLines) -> Explained:
    """Return the pairs of phase steps with which in each other's place everything agrees."""
    found: Explained = []
    for i, j in combinations(range(lines.steps if lines.steps <= _MOST_STEPS else 0), 2):
        order = list(range(lines.steps))
        order[i], order[j] = j, i
        found += _if_agrees(CodeMishap("exchanged", (i, j)), judge(lines, tuple(order)), lines.steps)
    return found


def _not_shown(lines: CodedLines) -> Explained:
    """Return the phase steps without which the others are those of a fringe and agree with the code.

    In its place a step gets what the others ask for, which takes five of them: of four any one can be made to
    fit.
    """
    steps = lines.steps
    if not 5 <= steps <= _MOST_STEPS:
        return []
    angles = 2.0 * pi * np.arange(steps) / steps
    basis = np.stack([np.ones(steps), np.cos(angles), np.sin(angles)])
    levels, found = lines.levels.astype(np.float32), list[tuple[CodeMishap, int]]()
    for f in range(steps):
        left = np.delete(np.arange(steps), f)
        fit = levels[left].T @ np.linalg.pinv(basis[:, left])
        mended = levels.copy()
        mended[f] = fit @ basis[:, f]
        now = judge(replace(lines, levels=mended))
        found += _if_agrees(CodeMishap("frame", (f,)), now, steps)
    return found


def _not_legible(lines: CodedLines, borders: Borders, found: Judgement) -> list[int]:
    """Return the bits without which, whatever they are at each border, the others agree with the phase."""
    each = [judged(borders, lines, found.seen.sigma, free=1 << k) for k in range(lines.bits)]
    least = min((one.total[1] for one in each), default=0)
    assert found.verdict is not None
    if least > _left(found.verdict):
        return []
    good = [k for k, one in enumerate(each) if one.in_order and one.total[1] == least]
    return [lines.bits - 1 - k for k in good]


def same_steps(levels: NDArray[Any], grey: GreyLevels, usable: NDArray[np.bool_]) -> tuple[int, int] | None:
    """Return two phase steps, (steps, pixels), that show the same; None where all differ.

    Steps k and l of a fringe with modulation B differ by 2 B sin(pi (k - l) / q) sin(phase + ..), of which
    the mean square, 2 B^2 sin^2, is added to the two variances of the noise. Pairs are judged where it is at
    least twice as much as that; they are the same below a quarter of it.
    """
    steps, own = len(levels), levels[:, usable].astype(np.float32)
    if own.shape[1] < 200 or steps > _MOST_STEPS:
        return None
    noise = 2.0 * grey.variance(own.mean(axis=0))
    # Of frames of which one is another's twin, most are still a fringe: the median pair tells the modulation.
    pairs = list(combinations(range(steps), 2))
    square = [float(np.mean(np.square(own[i] - own[j]) / noise)) - 1.0 for i, j in pairs]
    expected = np.array([2.0 * np.sin(pi * (j - i) / steps) ** 2 for i, j in pairs])
    power = float(np.median(square / expected))
    for pair, apart, shape in zip(pairs, square, expected, strict=True):
        if power * shape > _TELLING and apart < _ALIKE * power * shape:
            return pair
    return None


def same_patterns(above: Singles, doubt: Singles, usable: NDArray[np.bool_]) -> tuple[int, int] | None:
    """Return two bits whose patterns show the same, though they change within what is seen; None for none.

    Two patterns of a Gray code change at different places, so that none that changes is like another; pixels
    in doubt are left out.
    """
    sure = usable & np.all(np.abs(above) > doubt, axis=0)
    if np.count_nonzero(sure) < 200:
        return None
    bright = above[:, sure] > 0.0
    share = bright.mean(axis=1)
    varied = np.flatnonzero((share > _VARIES) & (share < 1.0 - _VARIES))
    for i, j in combinations(range(len(bright)), 2):
        if (i in varied or j in varied) and np.mean(bright[i] != bright[j]) < 0.1 * _VARIES:
            return i, j
    return None
