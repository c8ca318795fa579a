"""What the harmonics of a projector that is not linear add to the signal of ranging, and how it is taken out.

Every return a exp(i omega t) brings ghosts at multiples of omega that q phase steps cannot tell from
fringes: a false return of its own, or a part of a true one where the two coincide.
"""

from __future__ import annotations

from math import ceil, cos, log, pi, sin
from typing import NamedTuple

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import inner, kernel
from sms_jobs.metrology.phase.ranging.reference_fit import AMPLITUDE, OMEGA
from sms_jobs.metrology.phase.ranging.row import Row
from sms_jobs.metrology.phase.ranging.signal import Sequence, uniform_steps
from sms_jobs.metrology.phase.response import Response

_GRID = 32  # points a bin, between which the error of a ghost is interpolated
_LEFT = 1e-3  # of a ghost, once it is taken out


class Ghosts(NamedTuple):
    """What a return of amplitude 1 adds to the signal besides itself.

    Attributes
    ----------
    orders
        n of each harmonic, (harmonics,).
    forward, backward
        (harmonics, densities): amplitudes of exp(i n omega t) and of exp(-i n omega t).
    rounds
        How often returns and ghosts are found in turn.
    """

    orders: Floats
    forward: Singles
    backward: Singles
    rounds: int


NO_GHOSTS = Ghosts(np.zeros(0), np.zeros((0, 1), np.float32), np.zeros((0, 1), np.float32), 0)


def ghosts_of(response: Response, sequence: Sequence, steps: int) -> Ghosts:
    """Return the ghosts that a response makes in a sequence of q steps.

    Notes
    -----
    Frame k shows sum r_n cos(n (omega t + 2 pi k / q)); its weights c_k + i s_k make of harmonic n
    exp(i n omega t) sum (c_k + i s_k) exp(2 pi i n k / q) / 2, and the same with -i: nothing but for n = 1
    and n = -1 (mod q), or at t = 0, where two steps tell the signal. A ghost of a ghost is smaller by r_n
    each round: it is done when a thousandth is left.
    """
    orders = np.arange(2, len(response.harmonics) + 1)
    forward, backward = np.zeros((2, orders.size, sequence.count), complex)
    for index, t in enumerate(sequence.densities):
        own = sequence.frames[sequence.frames[:, 0] == index]
        k = np.arange(steps) if len(own) == steps else np.array(uniform_steps(steps))
        turn = np.exp(2j * pi * np.outer(orders, k) / steps)
        weights = own[:, 1] + 1j * own[:, 2]
        amplitudes = 0.5 * response.at_density(t)[1:] / response.harmonics[0]
        forward[:, index] = amplitudes * (turn @ weights)
        backward[:, index] = amplitudes * (turn.conj() @ weights)
    strongest = float(np.max(np.abs(forward) + np.abs(backward), initial=0.0))
    rounds = ceil(log(_LEFT) / log(min(strongest, 0.5))) if strongest > 0.0 else 0
    return Ghosts(
        orders.astype(np.float64), forward.real.astype(np.float32), backward.real.astype(np.float32), rounds
    )


def ghost_error(
    omega: Floats, amplitude: Singles, response: Response, densities: tuple[float, ...], steps: int
) -> Floats:
    """Return by how much ghosts that are not taken out move returns, in rad, at most.

    Parameters
    ----------
    omega, amplitude
        (returns, ...), as `range_returns` finds them; NaN where there is no such return.
    response
        Of the projector.
    densities, steps
        Of the sequence.

    Notes
    -----
    A ghost of amplitude b that is psi from a return of amplitude a moves it by
    sum t b sin(psi t) / (a sum t^2): least squares, to first order, of a return alone. The moduli of all
    ghosts of all returns are added.
    """
    t = np.array(densities, dtype=np.float64)
    grid = np.linspace(-pi, pi, _GRID * (ceil(densities[-1]) + 1))
    moved = np.zeros(omega.shape)
    for n in range(2, len(response.harmonics) + 1):
        sides = [side for side in (1, -1) if (n - side) % steps == 0]
        if not sides or response.harmonics[n - 1] == 0.0:
            continue
        strength = np.array([response.at_density(d)[n - 1] / response.harmonics[0] for d in densities])
        kernel_of = np.abs(np.sin(np.outer(grid, t)) @ (t * strength)) / np.sum(t * t)
        for side in sides:
            for other, light in zip(omega, amplitude, strict=True):
                apart = side * n * other - omega
                apart -= 2.0 * pi * np.rint(apart / (2.0 * pi))
                moved += np.nan_to_num(np.interp(apart, grid, kernel_of) * (light / amplitude))
    return moved


def ghost_level(amplitude: Singles, response: Response, densities: tuple[float, ...], steps: int) -> Floats:
    """Return what ghosts that are not taken out add to a frame, as a standard deviation in grey levels.

    Parameters
    ----------
    amplitude
        (returns, ...), as `range_returns` finds it; NaN where there is no such return.
    response, densities, steps
        As of `ghost_error`.

    Notes
    -----
    The residual is sqrt(q / 2) times the rms of either part of z: a ghost of amplitude b leaves b sqrt(q) / 2
    of it.
    """
    power = 0.0
    for n in range(2, len(response.harmonics) + 1):
        sides = sum((n - side) % steps == 0 for side in (1, -1))
        strength = np.array([response.at_density(d)[n - 1] / response.harmonics[0] for d in densities])
        power += sides * float(np.mean(strength**2))
    light = np.nansum(np.square(amplitude, dtype=np.float64), axis=0)
    return np.asarray(np.sqrt(0.25 * steps * power * light))


@inner
@kernel
def take_out_ghosts(ghosts: Ghosts, first: int, recorded: Singles, row: Row) -> None:
    """Write to the signal of a row what was recorded less the ghosts of its returns.

    `recorded` is (2, densities, columns), `first` t of the first density; densities that are left out stay 0.
    """
    row.signal[:] = recorded
    x, y = row.signal[0], row.signal[1]
    for j in range(row.returns.size):
        for i in range(row.returns[j]):
            omega, amplitude = row.estimates[j, i, OMEGA], row.estimates[j, i, AMPLITUDE]
            for m in range(ghosts.orders.size):
                angle = ghosts.orders[m] * omega
                c, s = cos(angle), sin(angle)
                p, q = cos(angle * first), sin(angle * first)
                for t in range(x.shape[0]):
                    if row.lost[t, j] == 0:
                        a, b = ghosts.forward[m, t], ghosts.backward[m, t]
                        x[t, j] -= amplitude * (a + b) * p
                        y[t, j] -= amplitude * (a - b) * q
                    p, q = c * p - s * q, s * p + c * q
