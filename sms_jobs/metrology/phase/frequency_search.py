"""Fringe orders of any list of densities, whole numbers or not, by trying all of them.

Where no difference of two densities is one fringe, as with the periods of heterodyne sets, there is nothing
to climb from (`unwrapping_plan`). The finest fringes leave one omega for each of their orders; the one that
agrees with the phases of all densities is taken where it is likely enough.
"""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.phase.phase_stepping import angle

WRONG_ORDER = 1e-4
"""Probability of another fringe order, given the frames, above which a pixel is ambiguous."""
BESIDE = 0.2
"""Rad of the finest fringes beyond the projector's edge, where noise may put a pixel."""
LEAST_DISTANCE_RAD = 0.05


def order_distance(densities: tuple[float, ...]) -> float:
    """Return by how many rad, as the length of a vector, the phases of two fringe orders differ at least.

    What another omega explains is taken off. Phases that scatter by a fraction of it tell orders apart.
    """
    t = np.array(densities, np.float64)
    orders = np.arange(1.0, t.max() - 1e-9)
    turns = np.outer(orders, t) / t.max()
    apart = 2.0 * pi * (turns - np.rint(turns))
    squares = np.sum(apart * apart, axis=1) - np.square(apart @ t) / np.sum(t * t)
    return float(np.sqrt(max(squares.min(), 0.0))) if orders.size else pi


@kernel
def _search_rows(
    frames: NDArray[Any], weights: Floats, t: Floats, noise: tuple[float, float], start: int, omega: Floats
) -> None:
    """Write omega of a block of rows, frames (densities * q, block, columns); NaN where it is ambiguous."""
    gain, read_noise = noise
    n, q = t.size, weights.shape[2]
    finest = np.argmax(t)
    t0, step = t[finest], 2.0 * pi / t[finest]
    phase, weight = np.empty(n), np.empty(n)
    for i in range(frames.shape[1]):
        for j in range(frames.shape[2]):
            level = slopes = 0.0
            for d in range(n):
                cosine = sine = 0.0
                for k in range(q):
                    value = np.float64(frames[d * q + k, i, j])
                    cosine += weights[d, 0, k] * value
                    sine += weights[d, 1, k] * value
                    level += value / (n * q)
                phase[d], weight[d] = angle(sine, cosine), cosine * cosine + sine * sine
            scale = 0.5 * q / (read_noise * read_noise + gain * level)
            for d in range(n):
                weight[d] *= scale
                slopes += weight[d] * t[d] * t[d]
            best, least, odds = np.nan, np.inf, 0.0
            # Likelihoods are summed relative to the best one so far; in the second round it is known, and
            # what the phases leave beyond noise makes all of them flatter.
            for turn in range(2):
                flat = 2.0 * max(least / max(n - 1, 1), 1.0)
                here = (
                    phase[finest] + 2.0 * pi * np.ceil((-pi * t0 - BESIDE - phase[finest]) / (2.0 * pi))
                ) / t0
                while here * t0 < pi * t0 + BESIDE:
                    pull = squares = 0.0
                    for d in range(n):
                        left = phase[d] - t[d] * here
                        left -= 2.0 * pi * np.rint(left * (0.5 / pi))
                        pull += weight[d] * t[d] * left
                        squares += weight[d] * left * left
                    squares -= pull * pull / slopes
                    if turn == 1:
                        odds += np.exp((least - squares) / flat)
                    elif squares < least:
                        least, best = squares, here + pull / slopes
                    here += step
            omega[start + i, j] = best if odds - 1.0 <= WRONG_ORDER * odds else np.nan


def find_orders(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    weights: Floats,
    *,
    gain: float,
    read_noise: float,
    threads: int = 1,
) -> Floats:
    """Return the phase gradient of every pixel, (rows, columns) in rad; NaN where the order is not sure.

    Parameters
    ----------
    frames
        (densities * q, rows, columns), densities slower than steps.
    densities
        Fringes across the projector, at least 1 each.
    weights
        (densities, 2, q): they turn the steps of a density into B cos and B sin of its phase.
    gain, read_noise
        Noise model: variance = read_noise^2 + gain * grey level, taken at the mean level.
    threads
        Number of threads; the result does not depend on it.

    Notes
    -----
    The squares left at an order, sum B_t^2 q / (2 sigma^2) (phi_t - omega t)^2 with omega their least-squares
    slope there, are -2 log likelihood. The probability of another order than the best is
    1 - L_best / sum L, equal odds before. Raises `InvalidInput` where two orders look alike.
    """
    distance = order_distance(densities)
    if distance < LEAST_DISTANCE_RAD:
        raise InvalidInput(
            f"fringe densities {', '.join(f'{t:g}' for t in densities)} leave two places of the projector "
            f"whose phases differ by {distance:.2g} rad, and {LEAST_DISTANCE_RAD:g} rad are needed: add a "
            f"density that separates them"
        )
    rows, columns = frames.shape[1:]
    omega = np.empty((rows, columns))
    t = np.array(densities, np.float64)

    def work(start: int, stop: int) -> None:
        block = np.ascontiguousarray(frames[:, start:stop])
        _search_rows(block, weights, t, (float(gain), float(read_noise)), start, omega)

    in_row_blocks(work, rows, threads, block=16)
    return omega
