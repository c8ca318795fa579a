"""Fringes where projector or pixel are not what the model takes them for: how far off points are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

import numpy as np

from sms_jobs.bench.fringes import bent_waveforms, fringe_textures
from sms_jobs.bench.fringes.bent_waveforms import Recording, scores
from sms_jobs.bench.fringes.fringe_textures import TexturedPlate
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.measurement import FringeSequence

_LADDER = (32, 31, 30, 28, 24, 16)
_BOTH, _ALONE = (0.0, pi / 2.0), (0.0,)


@dataclass(frozen=True)
class Case:
    """A recording that is drawn anew each time, and how it is reconstructed."""

    name: str
    record: Callable[[np.random.Generator], Recording]
    parameters: dict[str, Any]

    def judged(self, random: np.random.Generator) -> tuple[Floats, float]:
        """Return error over stated deviation of the valid points, and which part of the image is valid."""
        return scores(self.record(random), self.parameters)


def _bent(
    name: str,
    sequence: FringeSequence,
    gammas: tuple[float, float],
    parameters: dict[str, Any],
    *,
    twice: bool,
) -> Case:
    def record(random: np.random.Generator) -> Recording:
        noise = float(np.exp(random.uniform(np.log(0.001), np.log(0.005))))
        return bent_waveforms.record(random, sequence, random.uniform(*gammas), noise, twice=twice)

    return Case(name, record, {"blur_px": 0.0, **parameters})


def _textured(name: str, plates: tuple[TexturedPlate, ...], orientations: tuple[float, ...]) -> Case:
    sequence = FringeSequence(_LADDER, orientations_rad=orientations)

    def record(random: np.random.Generator) -> Recording:
        return fringe_textures.record(random, plates[random.integers(len(plates))], sequence)

    return Case(name, record, {})


_SQUARES = tuple(
    TexturedPlate("squares", size, blur, noise)
    for size in (1.5, 3.0, 6.0, 12.0)
    for blur in (0.25, 0.5, 0.7)
    for noise in (0.002, 0.004)
)
_BOX = tuple(
    TexturedPlate("squares", size, 0.0, noise) for size in (2.0, 6.0, 12.0) for noise in (0.002, 0.004)
)
_SPECKLE = tuple(
    TexturedPlate("speckle", 0.0, blur, noise) for blur in (0.0, 0.5) for noise in (0.002, 0.004)
)
_SMOOTH = tuple(
    TexturedPlate(pattern, 0.0, blur, noise)
    for pattern in ("plain", "waves")
    for blur in (0.0, 0.5)
    for noise in (0.002, 0.004)
)
_LINEAR = tuple(range(64))
_RANGED = {"method": "fdr", "returns": 2}

CASES = (
    _bent("two returns, exponent left", FringeSequence(_LINEAR), (1.5, 2.2), _RANGED, twice=True),
    _bent(
        "two returns, exponent measured",
        FringeSequence(_LINEAR),
        (1.5, 2.2),
        {**_RANGED, "response": "measured"},
        twice=True,
    ),
    _bent(
        "two returns of three steps, measured",
        FringeSequence(_LINEAR, 3),
        (1.2, 1.8),
        {**_RANGED, "response": "measured"},
        twice=True,
    ),
    _bent(
        "one direction of three steps, measured",
        FringeSequence(_LADDER, 3, _ALONE),
        (1.3, 2.2),
        {"response": "measured"},
        twice=False,
    ),
    _bent(
        "one direction of three steps, left", FringeSequence(_LADDER, 3, _ALONE), (1.1, 1.4), {}, twice=False
    ),
    _textured("squares", _SQUARES, _BOTH),
    _textured("squares in box pixels", _BOX, _BOTH),
    _textured("speckle", _SPECKLE, _BOTH),
    _textured("smooth", _SMOOTH, _BOTH),
    _textured("squares, one direction", _SQUARES + _BOX, _ALONE),
    _textured("smooth, one direction", _SMOOTH, _ALONE),
)


def rms(values: Floats) -> float:
    """Return the root mean square; 0 of nothing."""
    return sqrt(float(np.mean(np.square(values)))) if values.size else 0.0
