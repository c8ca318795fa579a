"""Patterns of other people: phases of their own, a Gray code beside the fringes, one modulation for all."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.shape.streaming import in_best_exposure, sampled
from sms_jobs.metrology.phase.gray_code import gradient_of_stripes, read_stripes
from sms_jobs.metrology.phase.joint_fit import JointCode, with_transfer
from sms_jobs.metrology.phase.temporal_unwrapping import CoarseGradient
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.subject import Subject

_DOUBT = 3.0  # standard deviations of the noise from the threshold, within which a bit may be misread
_ROWS, _COLUMNS = 24, 200  # of the pixels that tell what blur leaves


def refuse_foreign_patterns(subject: Subject, measurement: Measurement, instead: str) -> None:
    """Raise `InvalidInput` where patterns are not this program's own; `instead` says what can use them."""
    foreign = {
        "a Gray code": measurement.gray_code is not None,
        "one modulation for all densities": measurement.sequence.joint,
        "phases of their own": any(measurement.phase_offsets_rad),
    }
    what = next((name for name, is_so in foreign.items() if is_so), None)
    if what is not None:
        raise InvalidInput(f"the patterns of {subject} have {what}, which {instead} alone can use")


def offsets_of(measurement: Measurement) -> tuple[float, ...]:
    """Return what the patterns add to the phase of each density above 0; empty for nothing."""
    if not measurement.phase_offsets_rad:
        return ()
    each = zip(measurement.sequence.densities, measurement.phase_offsets_rad, strict=True)
    return tuple(offset for density, offset in each if density)


def joint_codes(measurement: Measurement) -> tuple[JointCode, ...]:
    """Return what the frames of each orientation show, of a sequence whose densities share a modulation.

    What blur leaves of each density is found in some of the pixels; empty for any other sequence.
    """
    sequence = measurement.sequence
    if not sequence.joint:
        return ()
    told, levels = told_code(sequence, offsets_of(measurement)), measurement.grey_levels
    some, _ = in_best_exposure(measurement, sampled(measurement.frames, _ROWS, _COLUMNS))
    each = range(len(sequence.orientations_rad))
    return tuple(with_transfer(some[sequence.frames_of(k)], told, levels) for k in each)


def told_code(sequence: FringeSequence, offsets: tuple[float, ...] = ()) -> JointCode:
    """Return what the frames of an orientation show; `offsets` in rad are added to each density's phase."""
    shown = [
        (density, offset + 2.0 * pi * step / sequence.steps)
        for density, offset in zip(
            sequence.densities, offsets or (0.0,) * len(sequence.densities), strict=True
        )
        for step in sequence.steps_of(density)
    ]
    densities, turns = np.array(shown, np.float64).T.copy()
    return JointCode(densities, turns, sequence.frames_of_anchor(0), np.ones(len(shown)))


def stated_by_what_is_left(
    sigma: NDArray[np.float32],
    phase_error: NDArray[np.float32],
    noise: NDArray[np.float32],
    code: JointCode,
) -> NDArray[np.float32]:
    """Return sigma, larger by what the joint model of an image leaves beyond noise.

    A projector that is not linear makes the squares of all pixels larger: the ratio of their median to that
    of the chi-square distribution tells how much. What is left repeats itself in frames of like phase, so
    that the excess does not become less in the mean over them: only the anchor's steps count as different.

    Parameters
    ----------
    sigma
        (pixels,), of the pixels that are trusted.
    phase_error, noise
        (pixels,): of one phase, as the frames leave it and as the camera's noise makes it.
    """
    if not sigma.size:
        return sigma
    expected = float(chdtri(code.freedom, 0.5)) / code.freedom
    excess = max(float(np.median(np.square(phase_error / noise))) / expected - 1.0, 0.0)
    return np.asarray(sigma * np.sqrt(1.0 + excess * len(code.densities) / code.steps), np.float32)


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
