"""The ripple of a projector's response as a table over the phase gradient, to correct whole images by.

Pixels have one phase gradient each, and the ripple depends on it alone: a table of some ten thousand entries
replaces as many iterations for every pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, pi

import numpy as np

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.phase.response import HARMONICS, Response, distortion, gradient_ripple

_ENTRIES = 32  # a period of the finest ripple: linear interpolation is off by (2 pi / 32)^2 / 8 = 0.5 % of it
_MARGIN = 0.1  # rad beyond -pi .. pi, more than any ripple


@dataclass(frozen=True)
class RippleTable:
    """What is true for a measured phase gradient; each (entries,).

    Attributes
    ----------
    measured
        Phase gradient as it is found, in rad, ascending.
    true
        Without its ripple, in rad.
    slope
        d true / d measured, by which noise is scaled.
    residual
        Root mean square over the densities, in rad, of what the harmonics leave in the phases beside their
        part in omega; in whichever direction of the complex plane.
    """

    measured: Floats
    true: Floats
    slope: Floats
    residual: Floats

    def corrected(self, omega: Floats) -> Floats:
        """Return phase gradients without their ripple, (...) in rad; NaN stays NaN."""
        return np.asarray(np.interp(omega, self.measured, self.true))

    def corrected_sigma(self, omega: Floats, sigma: Singles) -> Singles:
        """Return the standard deviations, (...) in rad, that corrected gradients have."""
        return np.asarray(np.interp(omega, self.measured, self.slope) * sigma, dtype=np.float32)

    def expected_error(self, omega: Floats) -> Floats:
        """Return the phase error in rad, (...), that the harmonics alone make; NaN stays NaN."""
        return np.asarray(np.interp(omega, self.measured, self.residual))


def ripple_table(response: Response, densities: Sequence[float], steps: int) -> RippleTable:
    """Tabulate the ripple that a response makes in the phase gradient of one return.

    Parameters
    ----------
    response
        Of the projector.
    densities, steps
        Of the sequence, without the density 0.

    Notes
    -----
    measured = true + ripple(true), read backwards. It is the ripple of temporal unwrapping; ranging with
    known origin solves sum B_t t Im[z_t exp(-i omega t)] = 0, the same to first order in the harmonics. It is
    that of all densities: a pixel that lost some of them to saturation keeps a part of its own.

    Raises `MeasurementFailed` for a response so far from linear that two phase gradients look alike.
    """
    cycles = (HARMONICS + 1) * max(densities)
    count = ceil(_ENTRIES * cycles * (1.0 + _MARGIN / pi))
    true = np.linspace(-pi - _MARGIN, pi + _MARGIN, count)
    ripple = gradient_ripple(response, true, densities, steps)
    measured = true + ripple
    if (np.diff(measured) <= 0.0).any():
        raise MeasurementFailed(
            "the projector's response is so far from linear that its ripple makes some phase gradients look "
            "alike, and cannot be corrected: use more phase steps, or send levels that undo the response"
        )
    squares, weight = np.zeros(count), 0.0
    for t in densities:
        power = float(response.at_density(t)[0]) ** 2
        left = distortion(response, true * t, t, steps) - 1.0 - 1j * t * ripple
        squares += power * np.square(np.abs(left))
        weight += power
    return RippleTable(measured, true, np.gradient(true, measured), np.sqrt(squares / weight))
