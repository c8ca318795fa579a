"""Patterns that another maker's projector showed: phases of their own, and a Gray code beside the fringes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.gray_code import gradient_of_stripes, read_stripes
from sms_jobs.metrology.phase.temporal_unwrapping import CoarseGradient
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.subject import Subject

_DOUBT = 3.0  # standard deviations of the noise from the threshold, within which a bit may be misread


def refuse_foreign_patterns(subject: Subject, measurement: Measurement, instead: str) -> None:
    """Raise `InvalidInput` where patterns are not this program's own; `instead` says what can use them."""
    if measurement.gray_code is not None or any(measurement.phase_offsets_rad):
        what = "a Gray code" if measurement.gray_code is not None else "phases of their own"
        raise InvalidInput(f"the patterns of {subject} have {what}, which {instead} alone can use")


def offsets_of(measurement: Measurement) -> tuple[float, ...]:
    """Return what the patterns add to the phase of each density above 0; empty for nothing."""
    if not measurement.phase_offsets_rad:
        return ()
    each = zip(measurement.sequence.densities, measurement.phase_offsets_rad, strict=True)
    return tuple(offset for density, offset in each if density)


def coarse_gradient(
    measurement: Measurement, orientation: int, rows: slice, fringes: NDArray[Any]
) -> CoarseGradient | None:
    """Return what a Gray code says of the rows of an orientation, before its fringes are unwrapped.

    Parameters
    ----------
    fringes
        (frames, rows, columns): those of the orientation, whose mean may be the threshold.
    """
    code, stack = measurement.gray_code, measurement.code_frames
    if code is None or stack is None:
        return None
    both = code.threshold == "inverse"
    first = orientation * (2 * code.bits if both else code.bits)
    frames = stack.rows(rows.start, rows.stop)
    mine = frames[first : first + code.bits]
    threshold: NDArray[np.float32]
    if both:
        # Half way between a pattern and its inverse: what is above it in the one is below it in the other.
        threshold = 0.5 * (mine.astype(np.float32) + frames[first + code.bits : first + 2 * code.bits])
    elif code.threshold == "white-black":
        threshold = frames[-2:].mean(axis=0, dtype=np.float32)
    else:
        threshold = fringes.mean(axis=0, dtype=np.float32)
    doubt = _DOUBT * measurement.noise(threshold)
    return gradient_of_stripes(read_stripes(mine, threshold, doubt), code.stripes)
