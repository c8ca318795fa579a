"""Where in the projector's image a camera pixel's light came from: phase gradients as projector pixels."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.phase.patterns import direction, span_px


def to_pixel(orientations: Sequence[float], columns: int, rows: int) -> Floats:
    """Return the (2, orientations) matrix from omega to pixels off the projector's centre, in px/rad.

    By least squares where there are more than two orientations; thesis Eq. (1.20) in pixel units. Raises
    `InvalidInput` for parallel orientations.
    """
    directions = np.array([direction(a) for a in orientations])
    if np.linalg.matrix_rank(directions, tol=1e-6) < 2:
        listed = ", ".join(f"{a:g}" for a in orientations)
        raise InvalidInput(f"fringe orientations {listed} rad are parallel: a ray needs two that cross")
    spans = np.array([span_px(columns, rows, a) for a in orientations])
    return np.asarray(np.linalg.pinv(directions) * (spans / (2.0 * pi)))


def projector_pixels(
    omega: Floats, omega_sigma: Singles, orientations: Sequence[float], columns: int, rows: int
) -> tuple[Floats, Singles]:
    """Return the projector's pixel that lit each camera pixel, and its standard deviation.

    Parameters
    ----------
    omega, omega_sigma
        (orientations, rows, columns) in rad per fringe.
    orientations
        Directions of the fringes in rad, at least two that cross.
    columns, rows
        Size of the projector's image.

    Returns
    -------
    (2, rows, columns): x and y in projector pixels, NaN where omega is; and the same of standard deviations.
    """
    matrix = to_pixel(orientations, columns, rows)
    centre = np.array([0.5 * (columns - 1), 0.5 * (rows - 1)])[:, None, None]
    pixels = np.tensordot(matrix, omega, axes=1) + centre
    variance = np.tensordot(matrix**2, np.square(omega_sigma, dtype=np.float64), axes=1)
    return pixels, np.sqrt(variance).astype(np.float32)
