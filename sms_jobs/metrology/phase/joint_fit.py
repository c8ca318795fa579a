"""Phase gradient from frames that share one mean and one modulation: micro and embedded phase shifting.

Where the densities lie close together blur takes nearly the same part of each, so that one of them, the
anchor, needs its three steps and all others fewer: F densities make F + 2 frames (Gupta and Nayar 2012), or
some more that have two steps each (Moreno, Son and Taubin 2015). All frames are fitted by one model,

    I_f = A + B m_f cos(omega t_f + d_f),

by most likelihood; m is what blur leaves of each density beside the anchor, one number for a whole image. The
anchor gives A, B and its wrapped phase, which leaves one omega for each of its fringe orders; the orders that
explain the other frames best are refined in A, B and omega together, and the best of them is taken where it
is likely enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel
from sms_jobs.metrology.phase.frequency_search import BESIDE, WRONG_ORDER
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.phase_stepping import angle
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient

_REFINED = 6  # fringe orders that are looked at closely
_ROUNDS = 2  # of refinement: the first starts within a tenth of a fringe
_LEAST_FRAMES = 4  # for three unknowns
_TRANSFER_ROUNDS, _LEAST_TRANSFER = 4, 0.7
_CLEAR = 10.0  # standard deviations of noise
_LEAST_PIXELS = 200


@dataclass(frozen=True)
class JointCode:
    """What the frames of one orientation show.

    Attributes
    ----------
    densities, turns
        (frames,): fringes across the projector, and what is added to the phase, in rad.
    anchor
        Where the frames of the density are that has three equal steps or more.
    transfer
        (frames,): modulation of each, as a part of the anchor's.
    """

    densities: Floats
    turns: Floats
    anchor: slice
    transfer: Floats

    def __post_init__(self) -> None:
        count = len(self.densities)
        if count < _LEAST_FRAMES or len(range(count)[self.anchor]) < 3:
            raise InvalidInput(
                f"frames that share one modulation are at least {_LEAST_FRAMES}, three of them of one "
                f"density, not {count}: add frames"
            )

    @property
    def steps(self) -> int:
        """How many frames the anchor has."""
        return len(range(len(self.densities))[self.anchor])

    @property
    def freedom(self) -> int:
        """How many frames there are beyond the three unknowns."""
        return len(self.densities) - 3


@inner
@kernel
def _refine(
    level: Floats, shown: Floats, camera: tuple[int, float, float], state: Floats, noise: Floats
) -> float:
    """Refine mean, modulation and omega, `state`, of one pixel; return -2 log likelihood.

    `noise` becomes the variance of omega, and the sum of squared residuals in units of their variance.
    """
    _, gain, read_noise = camera
    t, turn, transfer = shown[0], shown[1], shown[2]
    cost = np.inf
    for turn_number in range(_ROUNDS + 1):
        a, b, omega = state[0], state[1], state[2]
        n00 = n01 = n02 = n11 = n12 = n22 = 0.0
        r0 = r1 = r2 = 0.0
        square = logarithm = 0.0
        for f in range(level.size):
            phase = t[f] * omega + turn[f]
            c, s = transfer[f] * np.cos(phase), transfer[f] * np.sin(phase)
            expected = a + b * c
            variance = read_noise * read_noise + gain * max(expected, 0.0)
            weight = 1.0 / variance
            left = level[f] - expected
            slope = -b * t[f] * s
            square += weight * left * left
            logarithm += np.log(variance)
            n00 += weight
            n01 += weight * c
            n02 += weight * slope
            n11 += weight * c * c
            n12 += weight * c * slope
            n22 += weight * slope * slope
            r0 += weight * left
            r1 += weight * c * left
            r2 += weight * slope * left
        cost = square + logarithm
        noise[1] = square
        # The inverse of the symmetric 3 x 3 matrix by its cofactors.
        k00, k01, k02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
        k11, k12, k22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
        determinant = n00 * k00 + n01 * k01 + n02 * k02
        if not determinant > 0.0 or not b > 0.0:
            return np.inf
        noise[0] = k22 / determinant
        if turn_number < _ROUNDS:
            state[0] += (k00 * r0 + k01 * r1 + k02 * r2) / determinant
            state[1] += (k01 * r0 + k11 * r1 + k12 * r2) / determinant
            state[2] += (k02 * r0 + k12 * r1 + k22 * r2) / determinant
    return float(cost)


@inner
@kernel
def _likely_orders(
    level: Floats, shown: Floats, anchor: tuple[int, int], start: Floats, advance: Floats, kept: Floats
) -> int:
    """Fill `kept`, (orders, 2), with the squares left and omega of the likeliest fringe orders; their number.

    `start` are mean, modulation and wrapped phase of the anchor; `advance` (2, frames) are cosine and sine of
    what one fringe order adds to each frame's phase.
    """
    first, last = anchor
    t, turn, transfer = shown[0], shown[1], shown[2]
    t0, a, b = t[first], start[0], start[1]
    lowest = int(np.ceil((-pi * t0 - BESIDE - start[2]) / (2.0 * pi)))
    omega = (start[2] + 2.0 * pi * lowest) / t0
    cosine, sine = np.empty(level.size), np.empty(level.size)
    for f in range(level.size):
        phase = t[f] * omega + turn[f]
        cosine[f], sine[f] = np.cos(phase), np.sin(phase)
    count = 0
    while omega * t0 < pi * t0 + BESIDE:
        squares = 0.0
        for f in range(level.size):
            if first <= f < last:
                continue
            left = level[f] - a - b * transfer[f] * cosine[f]
            squares += left * left
            c = cosine[f] * advance[0, f] - sine[f] * advance[1, f]
            sine[f] = sine[f] * advance[0, f] + cosine[f] * advance[1, f]
            cosine[f] = c
        place = min(count, _REFINED - 1)
        if count < _REFINED or squares < kept[place, 0]:
            while place > 0 and kept[place - 1, 0] > squares:
                kept[place] = kept[place - 1]
                place -= 1
            kept[place, 0], kept[place, 1] = squares, omega
            count = min(count + 1, _REFINED)
        omega += 2.0 * pi / t0
    return count


@inner
@kernel
def _fit_pixel(
    level: Floats,
    shown: Floats,
    anchor: tuple[int, int],
    advance: Floats,
    camera: tuple[int, float, float],
    best: Floats,
) -> float:
    """Fit one pixel; return the probability of another fringe order.

    `best` becomes omega, its variance, modulation, mean, and the mean square left in units of its variance.
    """
    first, last = anchor
    count = last - first
    start, state, noise = np.zeros(3), np.empty(3), np.empty(2)
    cosine = sine = 0.0
    for f in range(first, last):
        start[0] += level[f] / count
        cosine += 2.0 / count * level[f] * np.cos(shown[1, f])
        sine -= 2.0 / count * level[f] * np.sin(shown[1, f])
    start[1], start[2] = np.sqrt(cosine * cosine + sine * sine), angle(sine, cosine)
    kept, cost = np.empty((_REFINED, 2)), np.empty(_REFINED)
    orders = _likely_orders(level, shown, anchor, start, advance, kept)
    best[0], best[1], best[2], best[3], best[4] = np.nan, np.nan, start[1], start[0], np.nan
    least = np.inf
    for m in range(orders):
        state[0], state[1], state[2] = start[0], start[1], kept[m, 1]
        cost[m] = _refine(level, shown, camera, state, noise)
        if cost[m] < least:
            least = cost[m]
            best[0], best[1], best[2], best[3] = state[2], noise[0], state[1], state[0]
            best[4] = noise[1] / (level.size - 3)
    if not least < np.inf:
        return 1.0
    # What the model does not explain makes every order's likelihood flatter.
    scale = 2.0 * max(best[4], 1.0)
    others = -1.0
    for m in range(orders):
        others += np.exp((least - cost[m]) / scale)
    return float(others / (1.0 + others))


@kernel
def _fit_rows(
    frames: NDArray[Any],
    shown: Floats,
    anchor: tuple[int, int],
    camera: tuple[int, float, float],
    start: int,
    omega: Floats,
    maps: Singles,
    flags: NDArray[np.uint8],
) -> None:
    """Fit a block of rows, frames (frames, block, columns), into whole maps from row `start` on.

    `shown` (3, frames) are densities, turns and transfer, `maps` are sigma, modulation, phase error and mean;
    `flags` saturated and ambiguous.
    """
    t = shown[0]
    count = t.size
    step = 2.0 * pi / t[anchor[0]]
    advance = np.empty((2, count))
    for f in range(count):
        advance[0, f], advance[1, f] = np.cos(t[f] * step), np.sin(t[f] * step)
    level, best = np.empty(count), np.empty(5)
    for i in range(frames.shape[1]):
        for j in range(frames.shape[2]):
            saturated = 0
            for f in range(count):
                level[f] = frames[f, i, j]
                saturated |= 1 if frames[f, i, j] >= camera[0] else 0
            wrong = _fit_pixel(level, shown, anchor, advance, camera, best)
            row = start + i
            noise = np.sqrt(camera[2] * camera[2] + camera[1] * max(best[3], 0.0))
            omega[row, j] = np.nan if saturated or wrong > WRONG_ORDER else best[0]
            maps[0, row, j] = np.nan if saturated or wrong > WRONG_ORDER else np.sqrt(best[1])
            maps[1, row, j] = best[2]
            maps[2, row, j] = np.sqrt(2.0 / (anchor[1] - anchor[0]) * best[4]) * noise / best[2]
            maps[3, row, j] = best[3]
            flags[0, row, j] = saturated
            flags[1, row, j] = 1 if wrong > WRONG_ORDER else 0


def fit_jointly(
    frames: NDArray[Any], code: JointCode, grey_levels: GreyLevels, threads: int = 1
) -> PhaseGradient:
    """Find the phase gradient of every pixel from the frames of one orientation.

    Parameters
    ----------
    frames
        (frames, rows, columns), uint8 or uint16, in the order of the code.
    code
        What they show.
    grey_levels
        Of the camera: variance = read_noise^2 + gain * grey level, taken at each frame's own expected level.
    threads
        Number of threads; the result does not depend on it.

    Returns
    -------
    Maps of the size of a frame. `saturated` is True where any frame is at full scale, `ambiguous` where
    another fringe order has a probability above `WRONG_ORDER`, given the frames and equal odds of all orders
    before. `phase_error` is what all frames leave, as the error of one phase of the anchor's steps, and
    `fitted` one more than the degrees of freedom, as of so many densities.

    Notes
    -----
    Maximum likelihood over A, B and omega with Gaussian noise whose variance follows the level; sigma is the
    square root of its Cramer-Rao bound. For K refined orders with the likelihoods L_k the probability of
    another order is 1 - L_best / sum L_k; where the squares left exceed their expectation by a factor, so
    does the variance that likelihoods are compared with. Raises `InvalidInput` for a wrong number of frames.
    """
    if len(frames) != len(code.densities):
        raise InvalidInput(
            f"the sequence has {len(code.densities)} frames an orientation, not {len(frames)}: check it"
        )
    rows, columns = frames.shape[1:]
    omega = np.empty((rows, columns))
    maps = np.empty((4, rows, columns), np.float32)
    flags = np.empty((2, rows, columns), np.uint8)
    first, last, _ = code.anchor.indices(len(frames))
    camera = (grey_levels.full_scale, float(grey_levels.gain), float(grey_levels.read_noise))
    shown = np.stack([code.densities, code.turns, code.transfer])

    def work(start: int, stop: int) -> None:
        block = np.ascontiguousarray(frames[:, start:stop])
        _fit_rows(block, shown, (first, last), camera, start, omega, maps, flags)

    with np.errstate(divide="ignore", invalid="ignore"):
        in_row_blocks(work, rows, threads, block=16)
    fitted = np.full((rows, columns), code.freedom + 1, np.uint8)
    saturated, ambiguous = flags.astype(bool)
    return PhaseGradient(omega, maps[0], maps[1], maps[2], maps[3], fitted, saturated, ambiguous)


def with_transfer(frames: NDArray[Any], code: JointCode, grey_levels: GreyLevels) -> JointCode:
    """Return a code with the transfer that some pixels show, frames (frames, rows, columns).

    It is fitted to the pixels whose fringe order is sure and whose modulation stands out from noise, in turn
    with these. A density that keeps less than 0.7 of the anchor's modulation, or more than its inverse, is no
    neighbour of it, or not the one that is told: its transfer stays 1, and the frames disagree.
    """
    count = len(code.densities)
    first, _, _ = code.anchor.indices(count)
    levels = frames.astype(np.float64).reshape(count, -1)
    for _ in range(_TRANSFER_ROUNDS):
        found = fit_jointly(frames, code, grey_levels)
        noise = np.sqrt(grey_levels.variance(found.mean_intensity))
        sure = (~found.ambiguous & ~found.saturated & (found.modulation > _CLEAR * noise)).ravel()
        if np.count_nonzero(sure) < _LEAST_PIXELS:
            return code
        omega, mean, modulation = (
            one.ravel()[sure].astype(np.float64)
            for one in (found.omega, found.mean_intensity, found.modulation)
        )
        wave = modulation * np.cos(np.outer(code.densities, omega) + code.turns[:, None])
        each = np.sum(wave * (levels[:, sure] - mean), axis=1), np.sum(wave * wave, axis=1)
        transfer = np.ones(count)
        for density in dict.fromkeys(code.densities.tolist()):
            own = code.densities == density
            kept = each[0][own].sum() / each[1][own].sum()
            transfer[own] = kept if _LEAST_TRANSFER < kept < 1.0 / _LEAST_TRANSFER else 1.0
        transfer /= transfer[first]
        code = replace(code, transfer=transfer)
    return code
