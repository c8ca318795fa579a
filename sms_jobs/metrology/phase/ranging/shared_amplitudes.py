"""Two returns that lie close in one fringe orientation, by the amplitudes that another orientation tells.

Of two returns that are d apart the signal shows their sum, and beside it little: its fall with t tells
a_1 a_2 d^2, and only the third power of t tells the two amplitudes from each other. Their places are then a
hundred times less sure than that of a return alone. But light is as bright in every orientation. Where
another orientation tells the same two returns well apart, its amplitudes are known here too, and the fall
alone gives the distance. What stays open is the side on which the weaker return lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks
from sms_jobs.metrology.phase.coded_lines import wrapped
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.harmonics import NO_GHOSTS, ghosts_of
from sms_jobs.metrology.phase.ranging.signal import Sequence, ranging_sequence, read_signal
from sms_jobs.metrology.phase.ranging.told_fit import DECIDED, Known, Model, Solved, fit_row, new_room
from sms_jobs.metrology.phase.response import Response

_TRIED_BINS = (0.05, 0.1, 0.2, 0.35, 0.55, 0.8, 1.1, 1.5)
_SAME_SIGMAS = 3.0  # within which two solutions are one


@dataclass(frozen=True)
class CloseReturns:
    """What is known of the returns of n pixels before.

    Attributes
    ----------
    where
        (rows, columns): True at these pixels.
    found
        (4, n): two omega and two amplitudes as the orientation itself tells them; NaN for a second return
        that was not found.
    told, told_sigma
        (2, n): amplitudes as another orientation tells them, and their standard deviations, grey levels.
    """

    where: Mask
    found: Floats
    told: Floats
    told_sigma: Floats


@dataclass(frozen=True)
class ToldApart:
    """What the amplitudes of another orientation make of two returns; all but the last are (2, n).

    Attributes
    ----------
    omega, omega_sigma, amplitude
        In rad per fringe and grey levels, in the order of the amplitudes that were told.
    ambiguous
        (n,): the weaker return may as well lie on the other side, at another place.
    against
        (n,): the signal speaks against the amplitudes.
    """

    omega: Floats
    omega_sigma: Singles
    amplitude: Singles
    ambiguous: Mask
    against: Mask


def tell_apart(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    steps: int,
    camera: GreyLevels,
    transfer: Floats,
    close: CloseReturns,
    *,
    response: Response | None = None,
    threads: int = 1,
) -> ToldApart:
    """Fit two returns to some pixels of an orientation, given their amplitudes.

    Parameters
    ----------
    frames, densities, steps, camera, response, threads
        As of `range_returns`, which see.
    transfer
        (densities,), modulation relative to that towards t = 0.
    close
        The pixels, and what is known of them.

    Notes
    -----
    Least squares of z(t) = g(t) sum a_i exp(i omega_i t) with the amplitudes as two further observations, by
    damped Gauss-Newton on either side of the stronger return. It starts from the middle of what was found and
    from that of a grid of distances at which |z|^2 falls as that of the amplitudes does; on the other side
    from where the solution is mirrored to. The side is told if its likelihood is 10^4 times that of the
    other; sides that give the same two places are no alternatives. The amplitudes are spoken against where
    they raise chi-square by as much, and where the signal tells no places with them.

    Raises `InvalidInput` for densities that cannot be ranged.
    """
    sequence = ranging_sequence(densities, steps, len(frames))
    model = _model(sequence, steps, transfer, response)
    rows, columns = np.nonzero(close.where)
    height, width = close.where.shape
    begins = np.searchsorted(rows, np.arange(height + 1))
    before = (np.nan_to_num(close.found), close.told, close.told_sigma)
    known = Known(*(np.ascontiguousarray(one.T) for one in before))
    solved = Solved(*(np.empty((len(rows), *shape)) for shape in ((2, 4), (2,), (2,), ())))
    stack = np.ascontiguousarray(frames)

    def work(start: int, stop: int) -> None:
        room = new_room(sequence.count)
        signal = np.empty((2, sequence.count, width), np.float32)
        lost = np.empty((sequence.count + 1, width), np.uint8)
        levels = np.empty((2, width), np.float32)
        for row in range(start, stop):
            first = int(begins[row])
            chosen = columns[first : begins[row + 1]]
            if not chosen.size:
                continue
            read_signal(stack, row, sequence.frames, camera.full_scale, signal[0], signal[1], lost, levels)
            variance = 2.0 / steps * (camera.read_noise**2 + camera.gain * levels[0, chosen])
            precision = np.asarray(sequence.precision[:, None] / variance, np.float32)
            fit_row(signal, lost, precision, chosen, first, model, known, solved, room)

    in_row_blocks(work, height, threads, block=16)
    return _judged(solved)


def _model(sequence: Sequence, steps: int, transfer: Floats, response: Response | None) -> Model:
    """Return what two returns show in a sequence."""
    ghosts = NO_GHOSTS if response is None else ghosts_of(response, sequence, steps)
    apart = 2.0 * pi / (sequence.first + sequence.count) * np.array(_TRIED_BINS)
    return Model(
        sequence.densities.astype(np.float32),
        np.asarray(transfer, np.float32),
        ghosts.orders,
        ghosts.forward,
        ghosts.backward,
        apart,
        np.cos(np.outer(apart, sequence.densities)).astype(np.float32),
    )


def _judged(solved: Solved) -> ToldApart:
    """Return the better of both sides, and whether to believe it."""
    every, better = np.arange(len(solved.misfits)), np.argmin(solved.misfits, axis=1)
    best, other = solved.solutions[every, better].T, solved.solutions[every, 1 - better].T
    low, high = np.sort(solved.misfits, axis=1).T
    sigma = solved.sigma.T
    return ToldApart(
        wrapped(best[:2]),
        sigma.astype(np.float32),
        best[2:].astype(np.float32),
        ambiguous=(high - low < DECIDED) & ~_same_places(best, other, sigma),
        against=(low > solved.without + DECIDED) | ~np.isfinite(sigma).all(axis=0),
    )


def _same_places(one: Floats, other: Floats, sigma: Floats) -> Mask:
    """Return where two solutions have the same two places, in whatever order."""
    orders = ((0, 1), (1, 0))
    ways = [np.abs(wrapped(one[:2] - other[list(order)])) <= _SAME_SIGMAS * sigma for order in orders]
    return np.asarray(ways[0].all(axis=0) | ways[1].all(axis=0))
