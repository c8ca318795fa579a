"""Checks whether fringes and the Gray code beside them are what they are said to be, along lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import degrees, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.shape.foreign_patterns import DOUBT, levels_mishap, offsets_of, pattern_contrast
from sms_jobs.kinds.shape.phase_task import Geometry
from sms_jobs.metrology.arrays import Mask
from sms_jobs.metrology.phase.code_borders import denied
from sms_jobs.metrology.phase.code_mishaps import (
    CodeMishap,
    Judgement,
    find_code_mishaps,
    judge,
    same_patterns,
    same_steps,
)
from sms_jobs.metrology.phase.coded_lines import CodedLines
from sms_jobs.metrology.phase.frame_fit import lit_pixels
from sms_jobs.metrology.phase.frame_order import frame_order
from sms_jobs.metrology.phase.patterns import span_px
from sms_jobs.records.measurement import Measurement

_MOST_STEPS = 12
"""Of more phase steps the fringes may lie beside the code by half of one of twelve all the same."""
_SOME = 2500  # pixels, of which single frames are compared
_NEAR = 3.0  # standard deviations from a whole number
_TOLD = 3  # explanations that are said, at most


@dataclass(frozen=True)
class _Seen:
    """Lines of all frames of a measurement, and what is told of them.

    Attributes
    ----------
    frames, starts
        From `FrameLines`: (patterns, pixels) and (pixels,).
    accepted_rad
        Phase error of the fringes themselves that is accepted.
    geometry
        Of camera and projector; None where it is not known.
    """

    measurement: Measurement
    frames: NDArray[Any]
    starts: Mask
    accepted_rad: float
    geometry: Geometry | None

    @property
    def directions(self) -> range:
        """The orientations, by their numbers."""
        return range(len(self.measurement.sequence.orientations_rad))

    @property
    def lowest(self) -> tuple[int, float]:
        """Place and number of the lowest density, the one that the code unwraps."""
        densities = [t for t in self.measurement.sequence.densities if t]
        return densities.index(min(densities)), min(densities)

    @cached_property
    def thinned(self) -> _Seen:
        """The same with some thousand of the pixels, spread over all lines."""
        every = max(1, len(self.starts) // _SOME)
        return replace(
            self, frames=np.ascontiguousarray(self.frames[:, ::every]), starts=self.starts[::every]
        )

    def along(self, orientation: int) -> str:
        """Name an orientation."""
        return f"along {degrees(self.measurement.sequence.orientations_rad[orientation]):g} deg"

    def shifted_from(self, first: int) -> _Seen:
        """Return the same with a frame put in before frame `first`, and the last left out."""
        return replace(self, frames=np.concatenate([self.frames[:first], self.frames[first - 1 : -1]]))

    def steps_of(self, orientation: int) -> NDArray[np.intp]:
        """Return the numbers of the frames of an orientation's fringes, (densities, steps)."""
        sequence = self.measurement.sequence
        every = np.arange(len(self.frames))[sequence.frames_of(orientation, uniform=False)]
        return every.reshape(-1, sequence.steps)

    def named(self, orientation: int, frame: int) -> str:
        """Name a frame of an orientation's fringes."""
        _, density, step = list(self.measurement.sequence.patterns())[frame]
        return f"{frame} ({density:g} fringes {self.along(orientation)}, step {step})"

    def coded(self, orientation: int, fringes_of: int | None = None) -> CodedLines:
        """Return what an orientation's code shows, with its own fringes or those of another."""
        code = self.measurement.sequence.gray
        assert code is not None
        above, _, noise = pattern_contrast(self.measurement, orientation, self.frames[:, None, :])
        place, density = self.lowest
        offsets = offsets_of(self.measurement)
        return CodedLines(
            self.frames[self.steps_of(orientation if fringes_of is None else fringes_of)[place]],
            above[:, 0],
            DOUBT * noise[..., 0, :],
            self.starts,
            density,
            code.stripes_of(orientation),
            offsets[place] if offsets else 0.0,
            self.measurement.grey_levels,
            self.accepted_rad,
            self._border_rad(orientation),
        )

    def _border_rad(self, orientation: int) -> float:
        """Return by how many rad of the lowest density borders of the code may lie beside their place.

        A projector shows stripes by whole pixels, and displaces their borders by half of one at most. Where
        it is not known how many it has, half a phase step is accepted: beyond, another step would fit better.
        """
        sequence = self.measurement.sequence
        step = pi / min(sequence.steps, _MOST_STEPS)
        if self.geometry is None:
            return step
        projector = self.geometry.pair.projector
        span = span_px(projector.columns, projector.rows, sequence.orientations_rad[orientation])
        return min(step, pi * self.lowest[1] / span)

    def patterns_mishap(self, orientation: int) -> str | None:
        """Say which frames of an orientation do not show a pattern of their own; None for none."""
        code = self.measurement.sequence.gray
        assert code is not None
        if code.threshold != "fringes":
            said = levels_mishap(self.measurement, orientation, self.thinned.frames)
            if said is not None:
                return f"{said}: record them again"
        grey = self.measurement.grey_levels
        for own in self.steps_of(orientation):
            levels = self.thinned.frames[own]
            if steps := same_steps(levels, grey, lit_pixels(levels, grey)):
                one, other = (self.named(orientation, int(own[step])) for step in steps)
                return f"frame {one} shows the same as frame {other}: record them again"
        lines = self.thinned.coded(orientation)
        if bits := same_patterns(lines.above, lines.doubt, lit_pixels(lines.levels, grey)):
            return "bits {} and {} show the same pattern: record them again".format(*bits)
        return None


@dataclass(frozen=True)
class CodeFinding:
    """What is wrong with fringes and code, in words, and whether that explains it: else it may be motion."""

    text: str
    explained: bool


def check_code(
    measurement: Measurement,
    lines: tuple[NDArray[Any], Mask],
    accepted_rad: float,
    geometry: Geometry | None,
) -> CodeFinding | None:
    """Say what is wrong with fringes and the Gray code beside them; None where they belong together.

    Parameters
    ----------
    lines
        From `FrameLines`: (patterns, pixels) and (pixels,).
    accepted_rad
        Phase error of the fringes themselves that is accepted.
    geometry
        Tells how many pixels the projector has; None where it is not known.

    Notes
    -----
    Frames that are as told are refused with a probability of some 1e-6: of each direction and bit, and of the
    density and the offset, it is 1e-7 (`code_borders.Verdict`). Nothing is said of fewer than 200 lit pixels.
    """
    told = _Seen(measurement, *lines, accepted_rad, geometry)
    found = [
        CodeFinding(f"{told.along(k)} {text}", True)
        for k in told.directions
        if (text := told.patterns_mishap(k))
    ]
    if found:
        found = _runs(told, list(told.directions)) or found
    else:
        coded = [told.coded(k) for k in told.directions]
        each = [judge(one) for one in coded]
        if all(one.agrees(measurement.sequence.steps) for one in each):
            found = _denied(told, each)
        else:
            found = _explained(told, coded, each)
    if not found:
        return None
    missing = _missing(told)
    return CodeFinding(missing, True) if missing else found[0]


def _denied(told: _Seen, found: list[Judgement]) -> list[CodeFinding]:
    """Say that the borders of all directions together deny the density; nothing where they do not."""
    lines = tuple(one.verdict.line for one in found if one.verdict is not None)
    if len(lines) < 2 or not denied(lines, told.accepted_rad):
        return []
    slope = sum(one.slope * one.spread for one in lines) / sum(one.spread for one in lines)
    asked = told.lowest[1] + slope
    variance = (
        sum(one.squares for one in lines) / sum(one.free for one in lines) / sum(one.spread for one in lines)
    )
    whole = abs(asked - round(asked)) < _NEAR * sqrt(variance)
    mishap = CodeMishap("density", actual=float(round(asked)) if whole else round(asked, 2))
    return [CodeFinding(": ".join(_one(told, 0, mishap)), mishap.sure)]


def _missing(told: _Seen) -> str:
    """Say in which block a frame is missing, those after it one too early; nothing where none seems to be.

    With a frame put in behind that block the other directions have to agree, and of a single one the levels
    of the code, which do not tell of which block it is.
    """
    sequence = told.measurement.sequence
    assert sequence.gray is not None
    early = "is missing, and those after it come one too early: record them again"
    blocks = [("fringes", k, sequence.frames_of(k)) for k in told.directions]
    blocks += [("code", k, sequence.code_frames_of(k)) for k in told.directions]
    for name, orientation, place in blocks:
        after = int(np.arange(len(told.frames))[place][-1]) + 1
        others = [k for k in told.directions if k != orientation]
        if after < len(told.frames) and others:
            mended = told.shifted_from(after)
            if all(_agree(mended, k) for k in others):
                return f"a frame of the {name} {told.along(orientation)} {early}"
    if len(told.directions) == 1 and sequence.gray.threshold != "fringes":
        mended = told.shifted_from(int(np.arange(len(told.frames))[sequence.frames_of(0)][-1]) + 1)
        as_told, now = (levels_mishap(one.measurement, 0, one.thinned.frames) for one in (told, mended))
        if now is None and (as_told is not None or not judge(told.coded(0)).seen.legible):
            return f"a frame of the fringes or the code {early}"
    return ""


def _agree(seen: _Seen, orientation: int) -> bool:
    if seen.patterns_mishap(orientation) is not None:
        return False
    found = judge(seen.coded(orientation))
    return found.telling and found.agrees(seen.measurement.sequence.steps)


def _explained(told: _Seen, coded: list[CodedLines], found: list[Judgement]) -> list[CodeFinding]:
    """Say what explains that fringes and code do not belong together; nothing where it may be chance.

    A word about all directions has to explain all of them, and comes before what explains one by one.
    """
    wrong = [k for k in told.directions if not found[k].agrees(coded[k].steps)]
    if runs := _runs(told, wrong):
        return runs
    mishaps = {
        k: find_code_mishaps(
            coded[k], found[k], tuple(told.coded(k, fringes_of=j) for j in told.directions if j != k)
        )
        for k in wrong
    }
    if len(wrong) == len(coded) > 1:
        words = [m for m in mishaps[0] if m.of_all and all(_like(m, mishaps[k]) for k in wrong)]
        if words:
            return [CodeFinding(_in_words(told, 0, words), words[0].sure)]
    said = []
    for k in wrong:
        own = [m for m in mishaps[k] if not m.of_all] if len(coded) > 1 else []
        if each := own or mishaps[k]:
            text = f"{told.along(k)} {_in_words(told, k, each)}"
            said.append(CodeFinding(text, each[0].sure))
        elif text := _unexplained(found[k], coded[k].steps):
            said.append(CodeFinding(f"{told.along(k)} {text}", False))
    return sorted(said, key=lambda one: not one.explained)


def _runs(told: _Seen, wrong: list[int]) -> list[CodeFinding]:
    """Say that all orientations that are wrong are runs of another number of steps; nothing where not."""
    steps = {_other_steps(told, k) for k in wrong}
    if steps == {0} or len(steps) != 1:
        return []
    text = f"they are runs of {steps.pop()} phase steps, not of {told.measurement.sequence.steps}"
    return [CodeFinding(f"{text}: correct the phase steps", True)]


def _other_steps(told: _Seen, orientation: int) -> int:
    """Return another number of steps that an orientation's frames begin with; 0 for none.

    Of one density: the frames of its code come next, and are no fringes.
    """
    sequence = told.measurement.sequence
    if len(told.steps_of(orientation)) > 1:
        return 0
    own = np.r_[sequence.frames_of(orientation), sequence.code_frames_of(orientation)]
    order = frame_order(told.frames[own])
    begins = order.steps != sequence.steps and order.runs == 1 and order.fringes[: order.steps].all()
    return order.steps if begins else 0


def _like(one: CodeMishap, others: list[CodeMishap]) -> bool:
    same = one.what != "beside"
    return any(
        one.what == o.what and one.text == o.text and (not same or one.actual == o.actual) for o in others
    )


def _unexplained(found: Judgement, steps: int) -> str:
    """Say what does not fit; nothing where that is no reason to refuse the frames."""
    seen, verdict = found.seen, found.verdict
    if verdict is None or not found.denies(steps):
        return ""
    if seen.broken >= 0.5:
        return (
            f"the phases of {seen.broken:.0%} of the neighbouring pixels have nothing to do with each other: "
            "see that steps and order are right, and record again"
        )
    if not seen.fits(steps):
        return (
            f"the phase steps leave {seen.misfit:.2g} times what noise and the accepted phase error explain, "
            "and nothing tells which frame it is: record them again"
        )
    if not seen.legible:
        return (
            f"the code can be read in {seen.read:.1%} of the pixels that show fringes: see that its frames, "
            "white and black are those that are told, and record again"
        )
    if not (verdict.in_order or verdict.mostly):
        count, wrong = verdict.total
        return (
            f"{wrong} of {count} stretches between borders of the code are not as long as the phase says: "
            "see that densities, steps, stripes and order are right, that nothing moved, and record again"
        )
    return (
        f"the borders of the code ask for {verdict.density:+.2f} fringes more than are told: see that "
        "densities and stripes are right"
    )


def _in_words(told: _Seen, orientation: int, mishaps: list[CodeMishap]) -> str:
    """Say what is wrong, and what to do: of several explanations the first three."""
    each = [_one(told, orientation, m) for m in mishaps]
    if len(each) == 1:
        return ": ".join(each[0])
    some = ", or ".join(words for words, _ in each[:_TOLD])
    return f"either {some}: see which, and record again or correct it"


def _one(told: _Seen, orientation: int, mishap: CodeMishap) -> tuple[str, str]:
    """Return what is wrong, and what to do about it."""
    place, density = told.lowest
    own, again = told.steps_of(orientation)[place], "record them again"
    if mishap.what == "density":
        found = f"the phases are those of {mishap.actual:g}"
        return f"{density:g} fringes are stated, but {found}", "correct the fringe densities"
    if mishap.what == "reversed":
        return "the phase steps run the other way than the code", "see direction, or turn their order round"
    if mishap.what == "patterns":
        text, _, remedy = mishap.text.partition(": ")
        return text, remedy if remedy.startswith("set") else f"correct their order, or {again}"
    if mishap.what == "exchanged":
        one, other = (told.named(orientation, int(own[step])) for step in mishap.frames)
        return f"frames {one} and {other} have changed places", f"correct their order, or {again}"
    if mishap.what == "frame":
        return f"frame {told.named(orientation, int(own[mishap.frames[0]]))} does not show its pattern", again
    if mishap.what == "fringes":
        return "fringes and code of two directions have changed places", f"correct their order, or {again}"
    if mishap.what == "pattern":
        return f"bit {mishap.frames[0]} of the code does not show its pattern", again
    limit = told.coded(orientation).border_rad
    return (
        f"the fringes lie {abs(mishap.actual):.2g} rad beside the code, and {limit:.2g} rad are accepted",
        "see which step and which origin they begin with, keep camera and specimen still, and record again",
    )
