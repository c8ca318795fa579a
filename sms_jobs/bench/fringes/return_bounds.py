"""The least standard deviation with which the phase gradients of superposed returns can be known."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.phase.phase_stepping import phase_sigma


def omega_bounds(
    omega: Floats,
    amplitude: Floats,
    densities: Floats,
    noise: float,
    steps: int = 4,
    *,
    mtf: Floats | None = None,
    known_origin: bool = True,
) -> Floats:
    """Return the Cramer-Rao bound of the standard deviation of each omega, (returns,), in rad per fringe.

    Parameters
    ----------
    omega, amplitude
        (returns,), in rad per fringe and grey levels.
    densities
        t of the sequence, q steps at each.
    noise, steps
        Standard deviation of a frame in grey levels; q.
    mtf
        Modulation relative to that towards t = 0; None for 1.
    known_origin
        True if every phase is known to be 0 at t = 0; else it is one more unknown of each return.

    Notes
    -----
    z(t) = g sum a_i exp(i (omega_i t + p_i)) has independent noise of variance 2 noise^2 / q in each part;
    the bound is the diagonal of the inverse Fisher matrix of omega_i, a_i (and p_i). One return:
    noise / (B sqrt(q / 2 sum t^2)), or with p sqrt(6) noise / (B s^1.5) for q = 4 and large s.
    """
    t = np.asarray(densities, dtype=np.float64)
    g = np.ones_like(t) if mtf is None else mtf
    turns = np.exp(1j * np.outer(omega, t)) * g
    slopes = np.asarray(amplitude)[:, None] * 1j * turns
    columns = [slopes * t, turns] if known_origin else [slopes * t, turns, slopes]
    jacobian = np.concatenate(columns)
    fisher = np.real(jacobian @ jacobian.conj().T)
    scale = np.sqrt(np.diag(fisher))
    inverse = np.linalg.inv(fisher / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(phase_sigma(noise, 1.0, steps) * np.sqrt(np.diag(inverse))[: len(omega)])


def two_return_bound(separation_bins: float, count: int = 64, *, known_origin: bool = True) -> float:
    """Return by how much a second return raises the bound of the first one's omega.

    `separation_bins` is in bins of 2 pi / s, s = `count` densities t = 0 .. s-1. The other amplitude does
    not matter, since it scales unknowns only. The unit is the known-origin bound of a single return, at
    which both numbers of `known_origin` can be compared.
    """
    t = np.arange(count, dtype=np.float64)
    pair = np.array([0.0, separation_bins * 2.0 * pi / count])
    bound = omega_bounds(pair, np.ones(2), t, 1.0, known_origin=known_origin)[0]
    return float(bound * sqrt(2.0 * np.sum(t * t)))
