"""What is left of a pixel beyond noise: light that is not as sharp as a return leaves it."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Singles


def misfit_factor(residual: Singles, noise: Singles, limit: float) -> Singles:
    """Return by which factor the deviations of a pixel's returns are larger than noise makes them.

    Parameters
    ----------
    residual, noise
        (rows, columns), standard deviations of a frame in grey levels: as the returns leave it, and as the
        camera makes it.
    limit
        Ratio of the two that noise alone stays below, of `phase_error_factor`: up to there the factor is 1.

    Returns
    -------
    (rows, columns), sqrt(1 + r^2 - limit^2) beyond: the a-posteriori variance of least squares, less what
    noise may have of it. NaN where there is no return.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = np.square(residual / noise) - limit**2
    return np.asarray(np.sqrt(1.0 + np.where(beyond <= 0.0, 0.0, beyond)), np.float32)
