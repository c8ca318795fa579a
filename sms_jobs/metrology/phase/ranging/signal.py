"""The complex signal z(t) of Fourier domain ranging, its weights, and how its modulation falls with t.

Frames of one orientation are I_k(t) = A + B cos(omega t + 2 pi k / q); the fundamental of the q steps is
z(t) = B exp(i omega t), thesis Eq. (6.4) without its factor of two. A sequence runs over t = 0 .. s-1 or
1 .. s. At t = 0 the light is uniform and z is real, so that two of its steps tell everything: see
`uniform_steps`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import inner, kernel
from sms_jobs.metrology.phase.phase_stepping import stepping_weights

Window = Literal["none", "hann", "hamming"]

PADDING = 16  # densities; vector instructions work on whole groups


@dataclass(frozen=True)
class Sequence:
    """What a kernel needs to know of a fringe sequence.

    Attributes
    ----------
    first
        Its lowest density, 0 or 1.
    count
        s, its number of densities.
    frames
        For each frame its density's index, its weights in B cos and in B sin, (frames, 3).
    precision
        (count,): 1 / variance of z(t), in units of that of a density with q steps.
    """

    first: int
    count: int
    frames: Floats
    precision: Floats

    @property
    def densities(self) -> Floats:
        """T of every density, (count,)."""
        return np.arange(self.first, self.first + self.count, dtype=np.float64)


def uniform_steps(steps: int) -> tuple[int, int]:
    """Return the two phase steps that are recorded at density 0: the brightest and the darkest one.

    At t = 0 step k is uniform light A + B cos(2 pi k / q): k = 0 is white, k = q // 2 the darkest. For
    q = 4 these are I_1 and I_3 of thesis section 7.2.2, which makes 4 s - 2 frames.
    """
    return 0, steps // 2


def ranging_sequence(densities: tuple[float, ...], steps: int, frames: int) -> Sequence:
    """Return the sequence of a list of densities, or say why it cannot be ranged.

    Parameters
    ----------
    densities
        Contiguous: 0 .. s-1 or 1 .. s, at least three.
    steps
        q, at least 3.
    frames
        Number of frames, density slower than step. Density 0 has either its two `uniform_steps` or all q;
        of the latter only the real part of z is used.

    Raises `InvalidInput` for other densities and for a wrong number of frames.
    """
    first, s = (int(densities[0]) if densities else -1), len(densities)
    if first not in (0, 1) or densities != tuple(range(first, first + s)) or s < 3:
        raise InvalidInput(
            f"Fourier domain ranging needs the fringe densities 0, 1, 2, ... or 1, 2, 3, ... without a gap "
            f"and at least 3, not {_shown(densities)}: record such a sequence or use temporal unwrapping"
        )
    weights = stepping_weights(steps)
    table = [[i, weights[0, k], weights[1, k]] for i in range(s) for k in range(steps)]
    precision = np.ones(s)
    short = s * steps - steps + 2
    if first == 0 and frames == short:
        _, dark = uniform_steps(steps)
        depth = 1.0 - cos(2.0 * pi * dark / steps)
        table = [[0, 1.0 / depth, 0.0], [0, -1.0 / depth, 0.0], *table[steps:]]
        precision[0] = depth * depth / steps  # (2 / q) / (2 / depth^2)
    elif first == 0:
        table = [[i, c, 0.0 if i == 0 else w] for i, c, w in table]
    if frames != len(table):
        alternative = f" (or {short} with two at density 0)" if first == 0 else ""
        raise InvalidInput(
            f"{s} fringe densities of {steps} steps make {s * steps} frames{alternative}, not {frames}: "
            f"check the fringe sequence"
        )
    return Sequence(first, s, np.array(table), precision)


def _shown(densities: tuple[float, ...]) -> str:
    text = ", ".join(str(t) for t in densities[:8])
    return f"({text}{', ...' if len(densities) > 8 else ''})"


def window_weights(window: Window, sequence: Sequence, *, known_origin: bool) -> Floats:
    """Return the window over the densities, (count,), 1 at its highest.

    A signal whose phase is known at t = 0 continues to negative t as its complex conjugate; its window
    therefore falls from t = 0 on. Without that knowledge it rises and falls over the sequence.
    Raises `InvalidInput` for a window that does not exist.
    """
    t = sequence.densities
    top = sequence.first + sequence.count
    if known_origin:
        raised = 0.5 + 0.5 * np.cos(pi * t / top)
    else:
        raised = 0.5 - 0.5 * np.cos(2.0 * pi * (t - sequence.first + 0.5) / sequence.count)
    floors = {"none": 1.0, "hann": 0.0, "hamming": 0.08}
    if window not in floors:
        raise InvalidInput(f"{window} is no window: use one of {', '.join(floors)}")
    return np.asarray(floors[window] + (1.0 - floors[window]) * raised)


@inner
@kernel
def _add_pair(
    frames: NDArray[Any], row: int, a: int, b: int, wa: float, wb: float, signal: Singles, i: int
) -> None:
    """Add two frames, with their weights, to row i of a part of the signal."""
    p, q = np.float32(wa), np.float32(wb)
    for j in range(signal.shape[1]):
        signal[i, j] += p * np.float32(frames[a, row, j]) + q * np.float32(frames[b, row, j])


@inner
@kernel
def _add_frames(
    frames: NDArray[Any], row: int, start: int, stop: int, table: Floats, x: Singles, y: Singles, i: int
) -> None:
    """Make the signal of a density of any number of frames."""
    x[i] = 0.0
    y[i] = 0.0
    half = (stop - start + 1) // 2
    for a in range(start, start + half):
        b = a + half if a + half < stop else a
        share = 1.0 if b != a else 0.0
        _add_pair(frames, row, a, b, table[a, 1], share * table[b, 1], x, i)
        _add_pair(frames, row, a, b, table[a, 2], share * table[b, 2], y, i)


@inner
@kernel
def _add_power(x: Singles, y: Singles, i: int, levels: Singles) -> None:
    for j in range(x.shape[1]):
        levels[1, j] += x[i, j] * x[i, j] + y[i, j] * y[i, j]


@inner
@kernel
def _add_levels(
    frames: NDArray[Any], row: int, start: int, stop: int, levels: Singles, highest: NDArray[Any]
) -> None:
    """Add the frames of one density to the sum of all, and keep the highest level of them."""
    highest[:] = 0
    for a in range(start, stop):
        for j in range(highest.size):
            levels[0, j] += np.float32(frames[a, row, j])
        for j in range(highest.size):
            highest[j] = max(highest[j], frames[a, row, j])


@inner
@kernel
def _add_four(
    frames: NDArray[Any], row: int, a: int, table: Floats, x: Singles, y: Singles, i: int, levels: Singles
) -> None:
    """Make the signal of a density of four frames, and add its levels and its power, in one go."""
    c0, c1 = np.float32(table[a, 1]), np.float32(table[a + 1, 1])
    c2, c3 = np.float32(table[a + 2, 1]), np.float32(table[a + 3, 1])
    s0, s1 = np.float32(table[a, 2]), np.float32(table[a + 1, 2])
    s2, s3 = np.float32(table[a + 2, 2]), np.float32(table[a + 3, 2])
    for j in range(x.shape[1]):
        p, q = np.float32(frames[a, row, j]), np.float32(frames[a + 1, row, j])
        r, s = np.float32(frames[a + 2, row, j]), np.float32(frames[a + 3, row, j])
        re = c0 * p + c1 * q + c2 * r + c3 * s
        im = s0 * p + s1 * q + s2 * r + s3 * s
        x[i, j] = re
        y[i, j] = im
        levels[0, j] += (p + q) + (r + s)
        levels[1, j] += re * re + im * im


@inner
@kernel
def _highest_of_four(frames: NDArray[Any], row: int, a: int, highest: NDArray[Any]) -> None:
    """Write the highest level of four frames."""
    for j in range(highest.size):
        highest[j] = max(
            max(frames[a, row, j], frames[a + 1, row, j]), max(frames[a + 2, row, j], frames[a + 3, row, j])
        )


@inner
@kernel
def _finish_density(
    highest: NDArray[Any],
    full_scale: int,
    x: Singles,
    y: Singles,
    i: int,
    lost: NDArray[np.uint8],
) -> None:
    """Take a density from the pixels that are at full scale in it."""
    top = highest[0]
    for j in range(highest.size):
        top = max(top, highest[j])
    if top >= full_scale:
        for j in range(highest.size):
            if highest[j] >= full_scale:
                x[i, j] = 0.0
                y[i, j] = 0.0
                lost[i, j] = 1
                lost[lost.shape[0] - 1, j] += 1


@kernel
def read_signal(
    frames: NDArray[Any],
    row: int,
    table: Floats,
    full_scale: int,
    x: Singles,
    y: Singles,
    lost: NDArray[np.uint8],
    levels: Singles,
) -> None:
    """Turn one row of all frames, (frames, rows, columns), into its signal.

    `x` and `y`, (count, columns), become z, 0 where a frame of the density is saturated, which `lost`
    (count + 1, columns) marks and counts in its last row; `levels` (2, columns) the mean of all frames and
    the rms of B over all t.
    """
    lost[:] = 0
    levels[:] = 0.0
    n = frames.shape[0]
    highest = np.empty(x.shape[1], frames.dtype)
    start = 0
    while start < n:
        i = int(table[start, 0])
        stop = start
        while stop < n and int(table[stop, 0]) == i:
            stop += 1
        if stop - start == 4:
            _add_four(frames, row, start, table, x, y, i, levels)
            _highest_of_four(frames, row, start, highest)
        else:
            _add_frames(frames, row, start, stop, table, x, y, i)
            _add_levels(frames, row, start, stop, levels, highest)
            _add_power(x, y, i, levels)
        _finish_density(highest, full_scale, x, y, i, lost)
        start = stop
    for j in range(x.shape[1]):
        levels[0, j] /= n
        levels[1, j] = np.sqrt(levels[1, j] / x.shape[0])
