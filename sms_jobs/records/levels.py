"""Levels of a stepped test: multiples of a step that a channel stays near, and the states made of them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from sms_jobs.records.triggers import Holding
from sms_jobs.records.units import time_words

_DIGITS = 12
"""Of a level: what a product of floating-point numbers adds beyond is nobody's load."""
_NUMBERED = re.compile(r"(?P<stem>[^0-9]*)(?P<number>[0-9]{1,12})")
_FIRST_OF_THEIR_FORM = "S"


@dataclass(frozen=True)
class Levels:
    """Every multiple of a step, 0 included, that a channel stays near.

    Attributes
    ----------
    channel, unit
        Of the rig, and the unit of its readings and of the numbers here.
    step
        Greater than twice the tolerance, so that no reading is near two levels.
    tolerance
        The channel is within it of a level.
    for_s
        How long it must have stayed there.
    """

    channel: str
    unit: str
    step: float
    tolerance: float
    for_s: float

    def __str__(self) -> str:
        near = f"{self.channel} = any multiple of {self.step:g} +- {self.tolerance:g} {self.unit}"
        return f"{near} for {time_words(self.for_s)}"

    def near(self, value: float) -> float | None:
        """Return the level that a reading is within the tolerance of; None where there is none."""
        steps = value / self.step
        if not math.isfinite(steps):
            return None
        level = float(f"{round(steps) * self.step:.{_DIGITS}g}") + 0.0  # which makes -0 a 0
        return level if abs(value - level) <= self.tolerance else None

    def at(self, level: float) -> Holding:
        """Return what a recording at a level waits for."""
        return Holding(self.channel, self.unit, level, self.tolerance, self.for_s)


def next_label(labels: Sequence[str]) -> str:
    """Return the label of one more state, in the form that the last numbered one has: S04 behind S03.

    Parameters
    ----------
    labels
        Of the states that there are, in order. Repeats, as S03.2, are of the state before the point.
    """
    numbered = [found for label in labels if (found := _NUMBERED.fullmatch(label))]
    if not numbered:
        stem, width, number = _FIRST_OF_THEIR_FORM, 2, len(labels)
    else:
        stem, width = numbered[-1]["stem"], len(numbered[-1]["number"])
        number = 1 + max(int(found["number"]) for found in numbered if found["stem"] == stem)
    taken = {label.casefold() for label in labels}
    while (label := f"{stem}{number:0{width}d}").casefold() in taken:
        number += 1
    return label
