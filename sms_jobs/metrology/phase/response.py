"""What a projector makes of the fringes that it is sent, found in the frames themselves, and its correction.

A projector whose brightness is not proportional to what it is sent adds harmonics to the fringes. Phase
stepping by q frames cannot tell harmonics k q - 1 and k q + 1 from the fringes, and the phase ripples. Over
many densities and pixels, though, every phase of the fringes is met in every step: once the phase gradient is
known, the grey levels against the predicted phase draw the fringe's mean waveform, and its harmonics are a
linear least-squares fit.

Ranging with several densities sees a harmonic as a line of its own far from the fringes' line; it is temporal
unwrapping that suffers from what is predicted here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Complexes, Floats
from sms_jobs.metrology.phase.patterns import fringe_harmonics
from sms_jobs.metrology.phase.phase_stepping import stepping_weights

HARMONICS = 6
"""Of a power law up to 2.2 the seventh harmonic is below 1e-4 of the fringe."""

_ROUNDS = 6  # each leaves less than a quarter of the ripple that the one before left in omega
_SETTLED = 1e-5  # change of a harmonic in a round after which no further one is needed
_INVERSIONS = 12  # the slope is largest, 0.6 at an exponent of 2 and q = 3, where all densities agree
_GAMMAS = (0.25, 4.0)


@dataclass(frozen=True)
class Response:
    """The waveform of the fringes as a camera sees them, and the projector's exponent behind it.

    Attributes
    ----------
    harmonics
        (n,): amplitude of harmonic 1 .. n in units of the fringe's own, for fringes so coarse that nothing
        blurs them.
    sigma
        (n,): their standard deviations.
    damping
        By which blur lowers harmonic n of density t: exp(-damping (n t)^2).
    gamma, gamma_sigma
        Exponent of the power law with the same second harmonic, and its standard deviation; NaN where no
        exponent between 0.25 and 4 has.
    visibility
        Of the patterns that were sent.
    """

    harmonics: Floats
    sigma: Floats
    damping: float
    gamma: float
    gamma_sigma: float
    visibility: float

    def at_density(self, density: float) -> Floats:
        """Return the amplitudes of harmonics 1 .. n at a density."""
        n = np.arange(1, len(self.harmonics) + 1)
        return np.asarray(self.harmonics * np.exp(-self.damping * np.square(n * density)))


def _fundamental(frames: Floats, densities: Sequence[float], steps: int) -> Complexes:
    """Return B exp(i phi) of every density, (densities, pixels)."""
    weights = stepping_weights(steps)
    grouped = frames.reshape(len(densities), steps, -1)
    return np.asarray(np.einsum("k,dkp->dp", weights[0] + 1j * weights[1], grouped))


def _damping(z: Complexes, densities: Floats) -> float:
    """Return by how much the logarithm of the modulation falls with t^2, at least 0."""
    if np.ptp(densities) == 0.0:
        return 0.0
    level = np.log(np.abs(z)).mean(axis=1)
    squares = np.square(densities) - np.mean(np.square(densities))
    return max(0.0, -float(np.sum(squares * level) / np.sum(np.square(squares))))


def _uniform_modulation(z: Complexes, densities: Floats, damping: float) -> Floats:
    """Return the modulation, (pixels,), that a fringe of density 0 would have."""
    kept = np.exp(-damping * np.square(densities))
    return np.asarray(kept @ np.abs(z) / np.sum(np.square(kept)))


def distortion(response: Response, phase: Floats, density: float, steps: int) -> Complexes:
    """Return by which factor phase stepping falsifies B exp(i phase); its angle is the phase's ripple.

    Parameters
    ----------
    response
        Of the projector.
    phase
        (...), true phase in rad.
    density
        Number of fringes t.
    steps
        Phase steps q.

    Notes
    -----
    1 + sum over n of r_n exp(i (n - 1) phi) for n = 1 (mod q), exp(-i (n + 1) phi) for n = -1 (mod q): the
    harmonics that q steps cannot tell from the fringes.
    """
    amplitudes = response.at_density(density)
    z = np.zeros(np.shape(phase), np.complex128)
    for n, amplitude in enumerate(amplitudes, start=1):
        if (n - 1) % steps == 0:
            z += amplitude * np.exp(1j * (n - 1) * phase)
        if (n + 1) % steps == 0:
            z += amplitude * np.exp(-1j * (n + 1) * phase)
    return np.asarray(z / amplitudes[0])


def gradient_ripple(response: Response, omega: Floats, densities: Sequence[float], steps: int) -> Floats:
    """Return by how much temporal unwrapping overestimates the phase gradient, in rad.

    Parameters
    ----------
    response
        Of the projector.
    omega
        (...), phase gradient in rad.
    densities, steps
        Of the sequence, without the density 0.

    Notes
    -----
    The phase ripples go through the same weighted fit as the phases: sum B_t^2 t d_t / sum B_t^2 t^2.
    """
    top, bottom = np.zeros(np.shape(omega)), np.zeros(np.shape(omega))
    for t in densities:
        z = distortion(response, omega * t, t, steps)
        power = np.square(response.at_density(t)[0] * np.abs(z))
        top += power * t * np.angle(z)
        bottom += power * t * t
    return np.asarray(top / bottom)


def corrected_gradient(response: Response, omega: Floats, densities: Sequence[float], steps: int) -> Floats:
    """Return the phase gradient without its ripple, (...) in rad, from that which unwrapping found.

    omega_true + ripple(omega_true) = omega, by fixed-point iteration: the ripple's slope is below 1.
    It costs no noise and needs no frames; parameters as of `gradient_ripple`.
    """
    true = np.asarray(omega, dtype=np.float64)
    for _ in range(_INVERSIONS):
        true = omega - gradient_ripple(response, true, densities, steps)
    return true


def _undistorted(
    z: Complexes, omega: Floats, densities: Sequence[float], steps: int, response: Response
) -> Complexes:
    """Return B exp(i phi) of every density without what the harmonics add to it."""
    return np.stack(
        [z[i] / distortion(response, omega * t, t, steps) for i, t in enumerate(densities)], axis=0
    )


def _refit(z: Complexes, omega: Floats, densities: Sequence[float]) -> Floats:
    """Return the phase gradient from the phases, whose fringe orders the last one tells."""
    top, bottom = np.zeros(omega.shape), np.zeros(omega.shape)
    for i, t in enumerate(densities):
        expected = omega * t
        power = np.square(np.abs(z[i]))
        top += power * t * (expected + np.angle(z[i] * np.exp(-1j * expected)))
        bottom += power * t * t
    return np.asarray(top / bottom)


def _waveform(
    levels: Floats, omega: Floats, densities: Sequence[float], steps: int, damping: float
) -> tuple[Floats, Floats]:
    """Fit the harmonics of normalised grey levels (frames, pixels); return them and their covariance."""
    normal, right, square = np.zeros((HARMONICS + 1, HARMONICS + 1)), np.zeros(HARMONICS + 1), 0.0
    basis = np.empty((HARMONICS + 1, omega.size))
    basis[0] = 1.0
    for i, t in enumerate(densities):
        for k in range(steps):
            basis[1] = np.cos(omega * t + 2.0 * pi * k / steps)
            for n in range(2, HARMONICS + 1):
                basis[n] = 2.0 * basis[1] * basis[n - 1] - basis[n - 2]
            basis[1:] *= np.exp(-damping * np.square(np.arange(1, HARMONICS + 1) * t))[:, None]
            level = levels[i * steps + k]
            normal += basis @ basis.T
            right += basis @ level
            square += float(level @ level)
    inverse = np.linalg.inv(normal)
    found = inverse @ right
    variance = max(square - float(found @ right), 0.0) / levels.size
    return found[1:], np.asarray(inverse[1:, 1:] * variance)


def phase_residual(
    frames: NDArray[Any], densities: Sequence[float], steps: int, omega: Floats, response: Response
) -> Floats:
    """Return the phase error of one phase, (pixels,) in rad, once the harmonics are taken out.

    Parameters as of `diagnose_response`. It is that of noise where a pixel sees one surface.
    """
    measured = _fundamental(frames.astype(np.float64), densities, steps)
    z = measured
    for _ in range(_ROUNDS):
        z, before = _undistorted(measured, omega, densities, steps, response), omega
        omega = _refit(z, omega, densities)
        if np.abs(omega - before).max() < _SETTLED / max(densities):
            break
    turned = z * np.exp(-1j * np.array(densities, dtype=np.float64)[:, None] * omega)
    power = np.square(np.abs(turned))
    square = np.sum(power * np.square(np.angle(turned)), axis=0) / power.sum(axis=0)
    return np.asarray(np.sqrt(square * len(turned) / (len(turned) - 1)))


def _second_harmonic(gamma: float, visibility: float) -> float:
    """Return the second harmonic of a power law in units of the fringe."""
    coefficients = fringe_harmonics(0, 1.0, visibility=visibility, gamma=gamma)
    return float(coefficients[2] / coefficients[1]) if len(coefficients) > 2 else 0.0


def _gamma(second: float, sigma: float, visibility: float) -> tuple[float, float]:
    """Return the exponent that gives a second harmonic, and its standard deviation."""
    from scipy.optimize import brentq

    low, high = (_second_harmonic(g, visibility) for g in _GAMMAS)
    if not low < second < high:
        return float("nan"), float("nan")
    gamma = float(brentq(lambda g: _second_harmonic(g, visibility) - second, *_GAMMAS))
    step = 1e-3
    rise = _second_harmonic(gamma + step, visibility) - _second_harmonic(gamma - step, visibility)
    return gamma, sigma * 2.0 * step / rise


def diagnose_response(
    frames: NDArray[Any], densities: Sequence[float], steps: int, omega: Floats, visibility: float = 1.0
) -> Response:
    """Find the projector's response in the frames of one orientation.

    Parameters
    ----------
    frames
        (densities * steps, pixels), grey levels of pixels that see one surface, none of them saturated; ten
        thousand are enough.
    densities, steps
        Of the sequence, without the density 0; at least two densities.
    omega
        (pixels,), phase gradient in rad as unwrapping finds it.
    visibility
        Of the patterns that were sent.

    Returns
    -------
    Harmonics, blur and exponent.

    Raises
    ------
    InvalidInput
        For one density: its harmonics k q - 1 and k q + 1 cannot be separated from its phase.

    Notes
    -----
    I = A + B sum r_n exp(-d n^2 t^2) cos(n (omega t + 2 pi k / q)): linear in r_n once A, B, d and omega are
    known. A is the pixel's mean, B and d come from its modulation over t, and omega is refitted to phases
    that are rid of the ripple that r_n predict, in a few rounds. Both harmonics and ripple are of the mean
    waveform over all pixels.
    """
    if len(set(densities)) < 2 or min(densities) < 1:
        raise InvalidInput(
            f"the projector's response needs two fringe densities from 1 on, not {tuple(densities)}"
        )
    levels = frames.astype(np.float64)
    t = np.array(densities, dtype=np.float64)
    measured = _fundamental(levels, densities, steps)
    levels -= levels.mean(axis=0)
    z, omega, before = measured, np.asarray(omega, dtype=np.float64), np.zeros(HARMONICS)
    for _ in range(_ROUNDS):
        damping = _damping(z, t)
        modulation = _uniform_modulation(z, t, damping)
        found, covariance = _waveform(levels / modulation, omega, densities, steps, damping)
        sigma = np.sqrt(np.diag(covariance)) / found[0]
        response = Response(found / found[0], sigma, damping, np.nan, np.nan, visibility)
        if np.abs(response.harmonics - before).max() < _SETTLED:
            break
        before = response.harmonics
        z = _undistorted(measured, omega, densities, steps, response)
        omega = _refit(z, omega, densities)
    gamma, gamma_sigma = _gamma(float(response.harmonics[1]), float(response.sigma[1]), visibility)
    return replace(response, gamma=gamma, gamma_sigma=gamma_sigma)
