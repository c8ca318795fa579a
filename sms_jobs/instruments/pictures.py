"""The pictures that projectors are given: patterns of a sequence as grey levels of 8 bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.camera import pixel_grid
from sms_jobs.metrology.phase.patterns import direction, fringe_pattern, phase_gradient, stripe_brightness
from sms_jobs.records.measurement import FringeSequence

_WHITE = 255

Levels = NDArray[np.uint8]


def pattern_brightness(sequence: FringeSequence, number: int, columns: int, rows: int) -> NDArray[np.float64]:
    """Return how bright a pattern of a sequence is, 0 .. 1, counted as a projector shows them.

    Of a pattern along an axis one line is returned, (1, columns) or (rows, 1), that all are like.
    """
    fringes, code = list(sequence.patterns()), list(sequence.code_patterns())
    stripes = code[number - len(fringes)] if number >= len(fringes) else None
    orientation = fringes[number][0] if stripes is None else stripes.orientation_rad
    across, down = direction(orientation)
    line = (columns if across else 1, rows if down else 1)
    if stripes is None:
        return fringe_pattern(*line, orientation, *fringes[number][1:], sequence.steps)
    omega = phase_gradient(pixel_grid(line[1], line[0]), *line, orientation)
    return stripe_brightness(omega, stripes.bits, stripes.stripes, stripes.bit, stripes.inverted)


def grey_levels(brightness: NDArray[np.float64], gamma: float) -> Levels:
    """Return the levels, 0 .. 255, at which a projector of that response is so bright, 0 .. 1."""
    return np.rint(_WHITE * np.clip(brightness, 0.0, 1.0) ** (1.0 / gamma)).astype(np.uint8)
