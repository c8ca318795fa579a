"""Which frame, or which word about the frames, is wrong where they contradict each other.

Each explanation changes one thing - a number of fringes, the order of two frames, one frame - and is tried on
a sample of the pixels: the one that leaves least is taken, if with it the frames agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from math import ceil
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.frame_fit import FrameFit, SampledFrames, fit_frames
from sms_jobs.metrology.phase.frame_order import frame_order
from sms_jobs.metrology.phase.sequences import SEQUENCES

Levels = NDArray[Any]
Fits = tuple[FrameFit, ...]
What = Literal["count", "list", "steps", "exchanged", "dark", "doubled", "gain", "other", "missing"]

_EXPLAINED = 0.6  # of the pixels agree with an explanation
_WORSE = 0.1  # by how much fewer may agree where frames agreed before
_FEW = 0.5  # of the pixels agree, below which single frames are suspected
_TRIED = 500  # pixels
_MOST_FRAMES = 100  # of which every two are exchanged
_FEW_FRAMES, _FEW_DENSITIES, _NEAR = 12, 3, 3
"""Of a longer recording these that fit worst are tried, and these numbers of fringes beside those told."""
_SAME = (
    2.0  # squared difference of two frames of one pattern, in units of its expectation from noise, at most
)
_DARK = 0.3  # of the expected scatter over the pixels
_ALIKE = 0.9  # correlation of a frame with what it should be, if the exposure alone is another


@dataclass(frozen=True)
class Mishap:
    """What is wrong.

    Attributes
    ----------
    what
        Which sort it is.
    frames
        Numbers of the frames, in the order of orientation, density and step, without the density 0.
    stated, actual
        The number that was told, and what it seems to be: of fringes, of steps; 0 where there is none. Of
        `gain` what is found is the factor, of `doubled` the frame that it is like.
    densities
        Of `list`: which they seem to be.
    """

    what: What
    frames: tuple[int, ...] = ()
    stated: float = 0
    actual: float = 0.0
    densities: tuple[float, ...] = ()


def find_mishap(told: tuple[SampledFrames, ...], fits: Fits) -> Mishap | None:
    """Find what is wrong with frames that do not agree; None where no single change explains them.

    Parameters
    ----------
    told
        The frames of each orientation at the same pixels.
    fits
        What `fit_frames` says of them.
    """
    step = max(1, told[0].levels.shape[1] // _TRIED)
    thin = tuple(one.thinned(step) for one in told)
    wrong = any(fit.few_agree for fit in fits)
    if wrong and (steps := _steps(thin)):
        return Mishap("steps", stated=told[0].steps, actual=steps)
    best, least = None, sum(fit.total for fit in fits)
    at_first = tuple(fit_frames(one) for one in thin)
    for mishap, changed in _explanations(thin, at_first, wrong):
        try:
            now = tuple(
                before if one is old else fit_frames(one)
                for one, old, before in zip(changed, thin, at_first, strict=True)
            )
        except InvalidInput:  # a list of densities that leaves the phase ambiguous
            continue
        total = sum(fit.total for fit in now)
        if total < least and all(map(_explains, at_first, now)):
            best, least = mishap, total
    return _named(best, thin) if best is not None and best.what == "other" else best


def _explains(before: FrameFit, now: FrameFit) -> bool:
    """Say whether a change explains frames: half of the pixels that did not agree do so now, or more."""
    if now.guilty.any():
        return False
    if before.few_agree:
        return now.share >= max(_EXPLAINED, 0.5 * (1.0 + before.share))
    return now.share >= before.share - _WORSE


def _explanations(
    told: tuple[SampledFrames, ...], fits: Fits, wrong: bool
) -> Iterator[tuple[Mishap, tuple[SampledFrames, ...]]]:
    """Yield what may be wrong, and the frames with that repaired."""
    each, count = len(told[0].levels), len(told) * len(told[0].levels)
    levels = np.concatenate([one.levels for one in told])
    doubtful = [fit.share < _FEW or bool(fit.guilty.any()) for fit in fits]
    suspects = [f for f in range(count) if doubtful[f // each]]
    misfit = np.concatenate([fit.misfit.ravel() for fit in fits])
    if count > _MOST_FRAMES:
        suspects = sorted(sorted(suspects, key=lambda f: -misfit[f])[:_FEW_FRAMES])

    def changed(frames: Levels, touched: set[int]) -> tuple[SampledFrames, ...]:
        parts = frames.reshape(len(told), each, -1)
        return tuple(replace(one, levels=parts[k]) if k in touched else one for k, one in enumerate(told))

    for f in suspects:
        mended = levels.copy()
        mended[f] = _expected(told[f // each], f % each)
        yield Mishap("other", (f,)), changed(mended, {f // each})
    for f, g in combinations(suspects, 2):
        swapped = levels.copy()
        swapped[[f, g]] = levels[[g, f]]
        yield Mishap("exchanged", (f, g)), changed(swapped, {f // each, g // each})
    if not wrong:
        return
    first = suspects[0] if suspects else count
    for f in range(first, count - 1) if count <= _MOST_FRAMES else suspects:
        shifted = np.concatenate([levels[:f], levels[f : f + 1], levels[f:-1]])
        k = f // each
        own = replace(told[k], levels=shifted.reshape(len(told), each, -1)[k])
        shifted[f] = _expected(own, f % each)
        yield Mishap("missing", (f,)), changed(shifted, set(range(k, len(told))))
    worst = None if count <= _MOST_FRAMES else misfit.reshape(len(told), len(told[0].densities), -1)
    for mishap, densities in _other_words(told[0].densities, worst):
        yield mishap, tuple(replace(one, densities=densities) for one in told)


def _other_words(
    told: tuple[float, ...], misfit: NDArray[np.float32] | None
) -> Iterator[tuple[Mishap, tuple[float, ...]]]:
    """Yield densities that may have been shown instead: one is another, or all are another named list.

    With the `misfit` of (orientations, densities, steps) those that fit worst alone are changed, by little.
    """
    largest = 2 * ceil(max(told)) + 2
    doubted = list(range(len(told)))
    if misfit is not None:
        doubted = sorted(doubted, key=lambda i: -misfit[:, i].sum())[:_FEW_DENSITIES]
    for i in doubted:
        t = told[i]
        for other in range(1, largest):
            if other not in told and (misfit is None or abs(other - t) <= _NEAR):
                yield Mishap("count", stated=t, actual=other), (*told[:i], other, *told[i + 1 :])
    named: set[tuple[float, ...]] = {
        tuple(t for t in make(s) if t) for make in SEQUENCES.values() for s in range(2, largest)
    }
    each = {one for densities in named | {told} for one in (densities, densities[::-1])}
    for densities in sorted(each - {told}):
        # Others of one number beside those told are tried already.
        if len(densities) == len(told) and sum(a != b for a, b in zip(told, densities, strict=True)) > 1:
            yield Mishap("list", densities=densities), densities


def _expected(one: SampledFrames, f: int) -> Levels:
    """Return what frame `f` has to be for the steps of its density to have the usual mean, (pixels,)."""
    n, q = len(one.densities), one.steps
    stack = one.levels.reshape(n, q, -1).astype(np.float32)
    i, k = divmod(f, q)
    usual = np.median(np.delete(stack.mean(axis=1), i, axis=0), axis=0) if n > 1 else stack[i].mean(axis=0)
    expected = q * usual - (stack[i].sum(axis=0) - stack[i, k])
    return np.asarray(np.clip(np.rint(expected), 0, one.grey_levels.full_scale).astype(one.levels.dtype))


def _steps(told: tuple[SampledFrames, ...]) -> int:
    """Return another number of steps of which the frames of every orientation are runs; 0 for none."""
    found = {order.steps if order.fringes.all() else 0 for order in (frame_order(o.levels) for o in told)}
    steps = found.pop()
    return 0 if found or steps == told[0].steps else steps


def _named(mishap: Mishap, told: tuple[SampledFrames, ...]) -> Mishap:
    """Say what a frame that does not show its pattern shows instead."""
    (number,) = mishap.frames
    each = len(told[0].levels)
    one = told[number // each]
    frame, expected = one.levels[number % each].astype(np.float32), _expected(one, number % each)
    if frame.std() < _DARK * expected.std() and frame.mean() < _DARK * expected.mean():
        return replace(mishap, what="dark")
    for k, other in enumerate(told):
        variance = 2.0 * other.grey_levels.variance(other.levels.mean(axis=0, dtype=np.float32))
        apart = np.mean(np.square(other.levels.astype(np.float32) - frame) / variance, axis=1)
        if k == number // each:
            apart[number % each] = np.inf
        if apart.min() < _SAME:
            return replace(mishap, what="doubled", actual=k * each + int(apart.argmin()))
    below = expected < 0.5 * one.grey_levels.full_scale
    if np.corrcoef(frame, expected)[0, 1] > _ALIKE and below.any():
        gain = float(np.median(frame[below] / np.maximum(expected[below], 1.0)))
        if abs(gain - 1.0) > one.accepted_level / 2.0:
            return replace(mishap, what="gain", actual=gain)
    return mishap
