"""Fourier domain ranging: the phase gradients of one or several returns from a linear fringe sequence.

Light that reaches a pixel from several places of the projector adds up in intensity, and so do the signals
z(t) = sum_i a_i exp(i omega_i t): over t = 0, 1, 2, ... each return is a peak of the Fourier transform
(thesis chapter 7). The thesis maximises |H|. Since every return's phase is zero at t = 0, the real part of H
with a real positive amplitude tells more: its standard deviation sigma / (B sqrt(q / 2 sum t^2)) is half of
that of |H| from the same frames, and it separates returns of half the distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, sqrt
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.compilation import in_row_blocks
from sms_jobs.metrology.phase.ranging.fit import fit_weights
from sms_jobs.metrology.phase.ranging.plan import JOINT, MODULUS, ORIGINAL, Plan
from sms_jobs.metrology.phase.ranging.search import find_by_peeling, find_jointly
from sms_jobs.metrology.phase.ranging.settled import settle_row
from sms_jobs.metrology.phase.ranging.signal import (
    PADDING,
    Window,
    ranging_sequence,
    read_signal,
    window_weights,
)
from sms_jobs.metrology.phase.ranging.start import grid
from sms_jobs.metrology.phase.ranging.transform import bit_reversal, transform_length, twiddles
from sms_jobs.metrology.phase.ranging.two_each import overlap_table

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]
Method = Literal["known-origin", "improved", "original"]

_METHODS = {"known-origin": 0, "improved": MODULUS, "original": MODULUS | ORIGINAL}
_LEAST_PART = 0.25  # of the densities that must be free of saturation


@dataclass(frozen=True)
class Returns:
    """What ranging says of every pixel, for one orientation.

    The first four are (returns, rows, columns), strongest return first, NaN where there is no such return;
    the others (rows, columns).

    Attributes
    ----------
    omega, omega_sigma
        Phase gradient in rad per fringe, in -pi .. pi, and its standard deviation from the noise model,
        the other returns' unknowns included.
    amplitude
        B of the return towards t = 0, in grey levels.
    width
        Spread of omega inside the return as a standard deviation in rad per fringe, from the fall of its
        amplitude with t that the modulation transfer does not explain; 0 where it is no wider than a point.
        Its own standard deviation is about 1.5 sqrt(sigma / B) / s for q = 4.
    count
        Number of returns found.
    residual
        What the returns leave, as an estimate of the standard deviation of a frame in grey levels: expected
        to be sqrt(read_noise^2 + gain * mean_intensity).
    mean_intensity
        Of all frames, in grey levels.
    modulation
        Root mean square over t of the B of the data, in grey levels, saturated densities included.
    saturated
        True where too few densities are free of saturated frames; there are no returns there.
    """

    omega: Floats
    omega_sigma: Single
    amplitude: Single
    width: Single
    count: NDArray[np.uint8]
    residual: Single
    mean_intensity: Single
    modulation: Single
    saturated: NDArray[np.bool_]


def score_threshold(significance: float, count: int) -> float:
    """Return the score above which a peak is a return, in standard deviations of noise alone.

    The score of white noise is a Gaussian process over omega; it crosses the level u upwards
    s / sqrt(3) exp(-u^2 / 2) times in -pi .. pi (Rice 1944), which is the part of pixels, `significance`,
    in which noise alone is taken for a return.
    """
    if not 0.0 < significance < 1.0:
        raise InvalidInput(f"the significance is a probability between 0 and 1, not {significance}: use 1e-4")
    return sqrt(max(2.0 * log(count / (sqrt(3.0) * significance)), 1.0))


def _row_buffers(
    count: int, columns: int
) -> tuple[Single, Single, NDArray[np.uint8], NDArray[np.int64], Floats]:
    """Return the signal of a row, its levels and lost densities, room for some of its columns and returns."""
    return (
        np.empty((2, count, columns), np.float32),
        np.empty((2, columns), np.float32),
        np.empty((count + 1, columns), np.uint8),
        np.empty(columns, np.int64),
        np.empty((7, columns)),
    )


def range_returns(
    frames: NDArray[Any],
    densities: tuple[int, ...],
    steps: int,
    *,
    full_scale: int,
    gain: float,
    read_noise: float,
    returns: int = 1,
    method: Method = "known-origin",
    refinements: int = 1,
    joint: bool = True,
    window: Window = "none",
    significance: float = 1e-4,
    mtf: Floats | None = None,
    threads: int = 1,
) -> Returns:
    """Find up to `returns` phase gradients of every pixel from the frames of one orientation.

    Parameters
    ----------
    frames
        (frames, rows, columns), uint8 or uint16, densities slower than steps.
    densities
        Fringes across the projector, 0 .. s-1 or 1 .. s. Density 0 has two frames, of the brightest and the
        darkest step (k = 0 and q // 2), or all q.
    steps
        q, phase steps a density, at least 3.
    full_scale
        Grey level from which on a frame is saturated; its density is left out of the pixel's fit.
    gain, read_noise
        Noise model: variance = read_noise^2 + gain * grey level, in grey levels; taken at the mean level.
    returns
        Most returns to look for in a pixel, 1 .. 8.
    method
        "known-origin" maximises Re H (least squares with the phase known at t = 0); "improved" and
        "original" maximise |H| as thesis sections 7.2.2 and 7.2.1 do, from the interpolated and from the
        whole frequency.
    refinements
        How often each return is found again with the others removed (thesis section 7.2.3, step 4); not
        used by the joint fit.
    joint
        Fit all returns together, and accept a further one by what it gains there; known-origin only.
    window
        Over the densities, for the search of peaks and, without a joint fit, for their refinement.
    significance
        Probability that noise alone is taken for a return.
    mtf
        (densities,), modulation relative to that towards t = 0, see `modulation_transfer`; None for 1.
    threads
        Number of threads; the result does not depend on it.

    Raises `InvalidInput` for densities with a gap, a wrong number of frames, and values out of range.
    """
    sequence = ranging_sequence(densities, steps, len(frames))
    if not 1 <= returns <= 8:
        raise InvalidInput(f"a pixel is searched for 1 to 8 returns, not {returns}: ask for fewer")
    if sequence.count > 255:
        raise InvalidInput(f"at most 255 fringe densities can be ranged, not {sequence.count}: give fewer")
    if refinements < 0:
        raise InvalidInput(f"the number of refinements is 0 or more, not {refinements}")
    if method not in _METHODS:
        raise InvalidInput(f"{method} is no ranging method: use one of {', '.join(_METHODS)}")
    known_origin = method == "known-origin"
    mode = _METHODS[method] | (JOINT if known_origin and joint else 0)
    transfer = np.ones(sequence.count) if mtf is None else np.asarray(mtf, dtype=np.float64)
    if transfer.shape != (sequence.count,) or not (transfer >= 0.0).all() or not transfer.any():
        raise InvalidInput(
            f"the modulation transfer has one value of 0 or more for each of the {sequence.count} densities, "
            f"not {transfer.shape}: estimate it from frames of the same sequence"
        )
    shape = window_weights(window, sequence, known_origin=known_origin)
    padded = -(-sequence.count // PADDING) * PADDING
    weights = fit_weights(
        sequence.densities, sequence.precision, transfer, shape, padded, windowed_fit=not mode & JOINT
    )
    length = transform_length(sequence.count)
    plan = Plan(
        sequence.first,
        max(3, int(_LEAST_PART * sequence.count)),
        mode,
        refinements,
        score_threshold(significance, sequence.count),
        2.0 / steps * read_noise**2,
        2.0 / steps * gain,
        sqrt(steps / 2.0),
        twiddles(length),
        bit_reversal(length),
        weights,
        weights.sum(axis=1, dtype=np.float64),
        overlap_table(sequence.densities, sequence.precision * transfer**2),
        grid(sequence.densities, sequence.precision * transfer**2, padded),
    )
    stack = np.ascontiguousarray(frames)
    rows, columns = stack.shape[1:]
    omega = np.empty((returns, rows, columns))
    maps = np.empty((3, returns, rows, columns), np.float32)
    planes = np.empty((3, rows, columns), np.float32)
    flags = np.empty((2, rows, columns), np.uint8)

    every = np.arange(columns)
    idle: list[tuple[Single, Single, NDArray[np.uint8], NDArray[np.int64], Floats]] = []

    def work(start: int, stop: int) -> None:
        # Fresh memory costs more to touch than a row costs to read: blocks hand on their buffers.
        buffers = idle.pop() if idle else _row_buffers(sequence.count, columns)
        signal, levels, lost, opened, known = buffers
        for row in range(start, stop):
            read_signal(stack, row, sequence.frames, full_scale, signal[0], signal[1], lost, levels)
            planes[:2, row] = levels
            if mode & JOINT:
                still = settle_row(plan, signal, lost, row, omega, maps, planes, flags, opened, known)
                if still > 0:
                    find_jointly(plan, signal, lost, opened[:still], known, row, omega, maps, planes, flags)
            else:
                find_by_peeling(plan, signal, lost, every, row, omega, maps, planes, flags)
        idle.append(buffers)

    in_row_blocks(work, rows, threads, block=4)
    return Returns(
        omega, maps[0], maps[1], maps[2], flags[0], planes[2], planes[0], planes[1], flags[1].astype(bool)
    )
