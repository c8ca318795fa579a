"""Two returns that lie close in one fringe orientation, by the amplitudes that another orientation tells.

Of two returns that are d apart the signal shows their sum, and beside it little: its fall with t tells
a_1 a_2 d^2, and only the third power of t tells the two amplitudes from each other. Their places are then a
hundred times less sure than that of a return alone. But light is as bright in every orientation. Where
another orientation tells the same two returns well apart, its amplitudes are known here too, and the fall
alone gives the distance. What stays open is the side on which the weaker return lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Complexes, Floats, Ints, Mask, Singles
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.harmonics import NO_GHOSTS, Ghosts, ghosts_of
from sms_jobs.metrology.phase.ranging.signal import ranging_sequence
from sms_jobs.metrology.phase.response import Response

_AT_ONCE = 2048  # pixels: some 30 MB
_TRIED_BINS = (0.05, 0.1, 0.2, 0.35, 0.55, 0.8, 1.1, 1.5)
_STEPS = 20
_NEGLIGIBLE = 1e-3  # gain in chi-square that is not worth another step
_EASIER, _HARDER, _DAMPING = 0.2, 10.0, 1e-3
_DECIDED = 2.0 * log(1e4)  # in chi-square: odds of 10^4, as of fringe orders
_SAME_SIGMAS = 3.0  # within which two solutions are one


@dataclass(frozen=True)
class CloseSignal:
    """The signal of pixels (n,) whose returns lie close.

    Attributes
    ----------
    signal
        z, (n, densities).
    weight
        (n, densities): inverse variance of each part of z; 0 where a density is left out.
    densities, transfer
        t, and the modulation there relative to that towards t = 0, (densities,).
    ghosts
        What the harmonics of the projector add to each return.
    """

    signal: Complexes
    weight: Floats
    densities: Floats
    transfer: Floats
    ghosts: Ghosts = NO_GHOSTS

    def chosen(self, which: Ints | slice) -> CloseSignal:
        """Return some of the pixels."""
        return CloseSignal(self.signal[which], self.weight[which], self.densities, self.transfer, self.ghosts)


def close_signal(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    steps: int,
    camera: GreyLevels,
    transfer: Floats,
    response: Response | None = None,
) -> CloseSignal:
    """Return the signal of pixels, from the frames of one orientation, (frames, n).

    The other arguments are those of `range_returns`, which see.
    """
    sequence = ranging_sequence(densities, steps, len(frames))
    signal = np.zeros((sequence.count, frames.shape[1]), np.complex128)
    lost = np.zeros(signal.shape, np.bool_)
    for frame, (index, real, imaginary) in zip(frames, sequence.frames, strict=True):
        signal[int(index)] += (real + 1j * imaginary) * frame
        lost[int(index)] |= frame >= camera.full_scale
    variance = 2.0 / steps * (camera.read_noise**2 + camera.gain * frames.mean(axis=0, dtype=np.float64))
    weight = np.where(lost, 0.0, sequence.precision[:, None] / variance).T
    ghosts = NO_GHOSTS if response is None else ghosts_of(response, sequence, steps)
    return CloseSignal(signal.T.copy(), weight.copy(), sequence.densities, transfer, ghosts)


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


def tell_apart(close: CloseSignal, found: Floats, told: Floats, told_sigma: Floats) -> ToldApart:
    """Fit two returns to signals, given their amplitudes.

    Parameters
    ----------
    close
        The signals.
    found
        (4, n): two omega and two amplitudes as they are known without; NaN for a second that was not found.
    told, told_sigma
        (2, n): amplitudes of the returns and their standard deviations, grey levels.

    Notes
    -----
    Least squares of z(t) = g(t) sum a_i exp(i omega_i t) with the amplitudes as two further observations, by
    damped Gauss-Newton from the best of a grid of distances on either side. The side is told if its
    likelihood is 10^4 times that of the other; sides that give the same two places are no alternatives.
    The amplitudes are spoken against where they raise chi-square by as much.
    """
    count, every = found.shape[1], _Fit(close, told, told_sigma)
    omega, sigma, amplitude = (np.empty((2, count)) for _ in range(3))
    ambiguous, against = np.empty(count, np.bool_), np.empty(count, np.bool_)
    for start in range(0, count, _AT_ONCE):
        part = slice(start, min(start + _AT_ONCE, count))
        fit = every.of(part)
        sides = [fit.solved(fit.best_start(found[:, part], side)) for side in (1.0, -1.0)]
        (first, low), (second, high) = sides
        best = np.where(low <= high, first, second)
        other = np.where(low <= high, second, first)
        omega[:, part], amplitude[:, part] = best[:2], best[2:]
        sigma[:, part] = spread = fit.omega_sigma(best)
        ambiguous[part] = (np.abs(low - high) < _DECIDED) & ~_same_places(best, other, spread)
        against[part] = np.minimum(low, high) > fit.misfit(np.nan_to_num(found[:, part])) + _DECIDED
    return ToldApart(omega, sigma.astype(np.float32), amplitude.astype(np.float32), ambiguous, against)


def _same_places(one: Floats, other: Floats, sigma: Floats) -> Mask:
    """Return where two solutions have the same two places, in whatever order."""
    ways = [np.abs(one[:2] - other[list(order)]) <= _SAME_SIGMAS * sigma for order in ((0, 1), (1, 0))]
    return np.asarray(ways[0].all(axis=0) | ways[1].all(axis=0))


@dataclass(frozen=True)
class _Fit:
    """The least squares of a number of pixels; solutions are (4, n): two omega and two amplitudes."""

    close: CloseSignal
    told: Floats
    told_sigma: Floats

    def of(self, which: Ints | slice) -> _Fit:
        """Return the fit of some of the pixels."""
        return _Fit(self.close.chosen(which), self.told[:, which], self.told_sigma[:, which])

    def best_start(self, found: Floats, side: float) -> Floats:
        """Return the best of a grid of distances about the middle of what was found."""
        places, light = found[:2], np.nan_to_num(found[2:])
        middle = np.nansum(places * light, axis=0) / light.sum(axis=0)
        share = self.told[1] / self.told.sum(axis=0)
        span = len(self.close.densities) + self.close.densities[0]
        best, least = np.empty((4, len(middle))), np.full(len(middle), np.inf)
        for bins in _TRIED_BINS:
            apart = side * bins * 2.0 * pi / span
            start = np.stack([middle - share * apart, middle + (1.0 - share) * apart, *self.told])
            misfit = self.misfit(start)
            best = np.where(misfit < least, start, best)
            least = np.minimum(misfit, least)
        return best

    def misfit(self, solution: Floats) -> Floats:
        """Return chi-square of the signals alone, (n,)."""
        return np.asarray(np.sum(self.close.weight * np.abs(self._residual(solution)) ** 2, axis=1))

    def solved(self, solution: Floats) -> tuple[Floats, Floats]:
        """Return the solution that starts at another, and chi-square there with the amplitudes'."""
        solution, damping = solution.copy(), np.full(solution.shape[1], _DAMPING)
        misfit = self._chi_square(solution)
        moving = np.arange(len(misfit))
        for _ in range(_STEPS):
            if not moving.size:
                break
            part = self.of(moving)
            normal, slope = part._equations(solution[:, moving])
            diagonal = np.einsum("nii->ni", normal)
            diagonal += damping[moving, None] * diagonal + np.finfo(np.float64).tiny
            step = np.linalg.solve(normal, slope[..., None])[..., 0]
            moved = solution[:, moving] + step.T
            after = part._chi_square(moved)
            better = after <= misfit[moving]
            solution[:, moving[better]] = moved[:, better]
            misfit[moving[better]] = after[better]
            damping[moving] *= np.where(better, _EASIER, _HARDER)
            moving = moving[~better | (np.einsum("ni,ni->n", step, slope) > _NEGLIGIBLE)]
        return solution, misfit

    def omega_sigma(self, solution: Floats) -> Floats:
        """Return the standard deviations of both omega, (2, n)."""
        normal, _ = self._equations(solution)
        unit = np.sqrt(np.einsum("nii->ni", normal))
        scale = unit[:, :, None] * unit[:, None, :]
        variance = np.einsum("nii->ni", np.linalg.inv(normal / scale)) / unit**2
        return np.asarray(np.sqrt(np.abs(variance[:, :2])).T)

    def _chi_square(self, solution: Floats) -> Floats:
        off = (self.told - solution[2:]) / self.told_sigma
        return np.asarray(self.misfit(solution) + np.sum(off**2, axis=0))

    def _residual(self, solution: Floats) -> Complexes:
        left = self.close.signal.copy()
        for omega, amplitude in zip(solution[:2], solution[2:], strict=True):
            left -= amplitude[:, None] * self._light(omega)
        return left

    def _light(self, omega: Floats, derivatives: int = 0) -> Complexes:
        """Return what a return of amplitude 1 shows, (n, densities), or a derivative of it by omega."""
        close, ghosts = self.close, self.close.ghosts
        turned = _turns(omega, close.densities)
        factor = (1j * close.densities) ** derivatives
        light = factor * close.transfer * turned
        for order, forward, backward in zip(ghosts.orders, ghosts.forward, ghosts.backward, strict=True):
            ahead = turned**order
            light += order**derivatives * factor * forward * ahead
            light += (-order) ** derivatives * factor * backward * ahead.conj()
        return light

    def _equations(self, solution: Floats) -> tuple[Floats, Floats]:
        """Return the normal matrix (n, 4, 4) and the right-hand side (n, 4) of a step."""
        places, lights = solution[:2], solution[2:]
        slopes = [light[:, None] * self._light(omega, 1) for omega, light in zip(places, lights, strict=True)]
        columns = np.stack([*slopes, *map(self._light, places)], axis=1).view(np.float64)
        weighted = columns * np.repeat(self.close.weight, 2, axis=1)[:, None]
        normal = weighted @ np.swapaxes(columns, 1, 2)
        slope = (weighted @ self._residual(solution).view(np.float64)[..., None])[..., 0]
        for k in (0, 1):
            weight = 1.0 / self.told_sigma[k] ** 2
            normal[:, 2 + k, 2 + k] += weight
            slope[:, 2 + k] += weight * (self.told[k] - solution[2 + k])
        return normal, slope


def _turns(omega: Floats, densities: Floats) -> Complexes:
    """Return exp(i omega t) of consecutive t, (n, densities): what is there, turned, is next."""
    turned = np.empty((len(omega), len(densities)), np.complex128)
    turned[:, 0] = np.exp(1j * omega * densities[0])
    done, turn = 1, np.exp(1j * omega)[:, None]
    while done < len(densities):
        more = min(done, len(densities) - done)
        np.multiply(turned[:, :more], turn, out=turned[:, done : done + more])
        done, turn = done + more, turn * turn
    return turned
