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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.batch import resolve_row
from sms_jobs.metrology.phase.ranging.batched_fit import overlap_table
from sms_jobs.metrology.phase.ranging.close_start import grid
from sms_jobs.metrology.phase.ranging.harmonics import NO_GHOSTS, Ghosts, ghosts_of, take_out_ghosts
from sms_jobs.metrology.phase.ranging.plan import Plan
from sms_jobs.metrology.phase.ranging.row import Maps, Row, begin_row, new_maps, new_row, write_row
from sms_jobs.metrology.phase.ranging.search import search_row
from sms_jobs.metrology.phase.ranging.signal import (
    PADDING,
    Sequence,
    Window,
    ranging_sequence,
    read_signal,
    window_weights,
)
from sms_jobs.metrology.phase.ranging.transform import transform_length, transform_of
from sms_jobs.metrology.phase.ranging.weights import fit_weights, sums_of
from sms_jobs.metrology.phase.response import Response

_PIXELS_AT_ONCE = 2048  # a call takes time, and so does to read a little of each frame; all stays in a cache
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
    omega_sigma: Singles
    amplitude: Singles
    width: Singles
    count: NDArray[np.uint8]
    residual: Singles
    mean_intensity: Singles
    modulation: Singles
    saturated: Mask


def score_threshold(significance: float, count: int) -> float:
    """Return the score above which a peak is a return, in standard deviations of noise alone.

    The score of white noise is a Gaussian process over omega; it crosses the level u upwards
    s / sqrt(3) exp(-u^2 / 2) times in -pi .. pi (Rice 1944), which is the part of pixels, `significance`,
    in which noise alone is taken for a return.
    """
    if not 0.0 < significance < 1.0:
        raise InvalidInput(f"the significance is a probability between 0 and 1, not {significance}: use 1e-4")
    return sqrt(max(2.0 * log(count / (sqrt(3.0) * significance)), 1.0))


@inner
@kernel
def _find_returns(plan: Plan, row: Row, columns: int) -> None:
    begin_row(plan, row)
    for start in range(0, row.returns.size, columns):
        resolve_row(plan, row, start, start + columns)
        search_row(plan, row, start, start + columns)


@kernel
def _range_row(plan: Plan, ghosts: Ghosts, row: Row, columns: int, maps: Maps, index: int) -> None:
    """Find the returns of a row that has been read, in turn with their ghosts, and write them to the maps.

    Every `columns` of its pixels are a row of the image, which is ranged by itself.
    """
    _find_returns(plan, row, columns)
    if ghosts.rounds > 0:
        recorded = row.signal.copy()
        for _ in range(ghosts.rounds):
            take_out_ghosts(ghosts, plan.first, recorded, row)
            _find_returns(plan, row, columns)
    write_row(plan, row, maps, index)


def range_returns(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    steps: int,
    camera: GreyLevels,
    *,
    returns: int = 1,
    window: Window = "none",
    significance: float = 1e-4,
    mtf: Floats | None = None,
    response: Response | None = None,
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
    camera
        Its grey levels: the density of a saturated frame is left out of the pixel's fit, and the noise is
        taken at the mean level.
    returns
        Most returns to look for in a pixel, 1 .. 8.
    window
        Over the densities, for the search of peaks; the fit itself has none.
    significance
        Probability that noise alone is taken for a return.
    mtf
        (densities,), modulation relative to that towards t = 0, see `modulation_transfer`; None for 1.
    response
        Of the projector, whose harmonics are taken out of the signal; None for a linear one.
    threads
        Number of threads; the result does not depend on it.

    Raises `InvalidInput` for densities with a gap, a wrong number of frames, and values out of range.
    """
    sequence = ranging_sequence(densities, steps, len(frames))
    if not 1 <= returns <= 8:
        raise InvalidInput(f"a pixel is searched for 1 to 8 returns, not {returns}: ask for fewer")
    if sequence.count > 255:
        raise InvalidInput(f"at most 255 fringe densities can be ranged, not {sequence.count}: give fewer")
    noise = 2.0 / steps * camera.read_noise**2, 2.0 / steps * camera.gain, sqrt(steps / 2.0)
    plan = _plan(sequence, window, score_threshold(significance, sequence.count), noise, mtf)
    ghosts = NO_GHOSTS if response is None else ghosts_of(response, sequence, steps)
    rows, columns = frames.shape[1:]
    maps = new_maps(returns, rows, columns)
    long = columns * _rows_at_once(rows, columns)
    stack = np.ascontiguousarray(frames).reshape(len(frames), -1, long)
    long_maps = Maps._make(one.reshape(*one.shape[:-2], -1, long) for one in maps)
    idle: list[Row] = []

    def work(start: int, stop: int) -> None:
        # Fresh memory costs more to touch than a row costs to read: blocks hand on their buffers.
        row = idle.pop() if idle else new_row(returns, sequence.count, long)
        for index in range(start, stop):
            read_signal(
                stack,
                index,
                sequence.frames,
                camera.full_scale,
                row.signal[0],
                row.signal[1],
                row.lost,
                row.levels,
            )
            _range_row(plan, ghosts, row, columns, long_maps, index)
        idle.append(row)

    in_row_blocks(work, stack.shape[1], threads, block=1)
    return Returns(*maps)


def _rows_at_once(rows: int, columns: int) -> int:
    """Return how many rows of an image are read and written as one: a divisor of their number."""
    most = max(_PIXELS_AT_ONCE // max(columns, 1), 1)
    return max((n for n in range(1, min(most, rows) + 1) if rows % n == 0), default=1)


def _plan(
    sequence: Sequence,
    window: Window,
    threshold: float,
    noise: tuple[float, float, float],
    mtf: Floats | None,
) -> Plan:
    """Return what is the same for all pixels; `noise` are the `variance`, `slope` and `unit` of a `Plan`."""
    transfer = np.ones(sequence.count) if mtf is None else np.asarray(mtf, dtype=np.float64)
    if transfer.shape != (sequence.count,) or not (transfer >= 0.0).all() or not transfer.any():
        raise InvalidInput(
            f"the modulation transfer has one value of 0 or more for each of the {sequence.count} densities, "
            f"not {transfer.shape}: estimate it from frames of the same sequence"
        )
    t, precision = sequence.densities, sequence.precision
    padded = -(-sequence.count // PADDING) * PADDING
    shape = window_weights(window, sequence, known_origin=True)
    weights = fit_weights(t, precision, transfer, shape, padded)
    return Plan(
        sequence.first,
        sequence.count,
        max(3, int(_LEAST_PART * sequence.count)),
        threshold,
        *noise,
        transform_of(transform_length(sequence.count)),
        weights,
        sums_of(weights, sequence.first),
        overlap_table(t, precision * transfer**2),
        grid(t, precision * transfer**2, padded),
    )
