"""What two returns that were found as one leave uncertain.

Where one orientation tells two returns apart and another finds one, the latter's two are closer than it can
tell. Its omega is then their mean, off the direct light's by an amount that no residual shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

from sms_jobs.metrology.arrays import Singles


def merged_sigma(
    noise: Sequence[Singles],
    chosen: Singles,
    amplitudes: Sequence[Singles],
    *,
    threshold: float,
    densities: int,
    steps: int,
) -> Singles:
    """Return by how much omega of a merged return may be off, as a standard deviation in rad.

    Parameters
    ----------
    noise
        Of each orientation, (rows, columns): standard deviation of a frame, grey levels.
    chosen
        (orientations, rows, columns): amplitude of the chosen return, grey levels.
    amplitudes
        Of each orientation, (returns, rows, columns): of all its returns, NaN where there is none.
    threshold
        Score from which on a further return is found, see `score_threshold`.
    densities, steps
        s and q.

    Returns
    -------
    (orientations, rows, columns); 0 where no orientation found more returns.

    Notes
    -----
    Returns a_1, a_2 that are d apart, A = a_1 + a_2, lower the modulation by A p t^2 / 2 with
    p = a_1 a_2 d^2 / A^2. Once A is fitted this gains (A p / 2)^2 (4 / 45) s^5 / sigma_z^2 in chi-square,
    sigma_z^2 = 2 sigma^2 / q, and a second return is found when that is the threshold squared. The mean is
    then off by d a_2 / A = sqrt(p a_2 / a_1); of all smaller distances alike, the rms is that over sqrt(3).
    a_2 / a_1 is known from an orientation that tells them apart.
    """
    counts = np.stack([np.isfinite(one).sum(axis=0) for one in amplitudes])
    totals = np.stack([np.nansum(one, axis=0) for one in amplitudes])
    telling = counts.argmax(axis=0)[None]
    with np.errstate(divide="ignore", invalid="ignore"):
        chosen_amplitude = np.take_along_axis(chosen, telling, axis=0)
        others = np.maximum(np.take_along_axis(totals, telling, axis=0) / chosen_amplitude - 1.0, 0.0)
        lever = threshold * sqrt(45.0 / 4.0) / densities**2.5
        p = 2.0 * sqrt(2.0 / steps) * np.stack(noise) / chosen * lever
        off = np.sqrt(p * others / 3.0)
    return np.where((counts < counts.max(axis=0)) & (counts > 0), off, 0.0).astype(np.float32)
