"""What anyone would write with NumPy or OpenCV in a few lines, to compare ours with."""

from __future__ import annotations

from math import pi
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats

_MARGIN_PX = 8  # round a subset, of what is given to OpenCV of the other image


def unwrapped_by_numpy(
    frames: NDArray[np.uint16], densities: tuple[float, ...], steps: int
) -> tuple[Floats, Floats, Floats]:
    """Return phase gradient, modulation and residual of phase of every pixel, each (rows, columns).

    The phase of every density by its discrete Fourier sum, in single precision; the differences of the first
    density to the others, fewest fringes first, tell the fringe order of the next; slope through the origin
    by weighted least squares.

    Parameters
    ----------
    frames
        (densities * steps, rows, columns), densities slower than steps; a reverse-exponential sequence.
    densities, steps
        Fringes across the projector, and phase steps of each.
    """
    angle = 2.0 * pi * np.arange(steps) / steps
    rows, columns = frames.shape[1:]
    phases, powers = [], []
    for first in range(0, len(frames), steps):
        stack = frames[first : first + steps].reshape(steps, -1).astype(np.float32)
        real = (np.cos(angle).astype(np.float32) @ stack) * np.float32(2.0 / steps)
        imaginary = (-np.sin(angle).astype(np.float32) @ stack) * np.float32(2.0 / steps)
        phases.append(np.arctan2(imaginary, real))
        powers.append(real * real + imaginary * imaginary)
    slope, absolute = np.zeros(rows * columns, np.float32), list(phases)
    turn = np.float32(2.0 * pi)
    for k in range(1, len(densities)):
        fringes = densities[0] - densities[k]
        difference = phases[0] - phases[k]
        difference -= turn * np.rint((difference - slope * fringes) / turn)
        slope = difference / np.float32(fringes)
    for k, fringes in enumerate(densities):
        absolute[k] = phases[k] - turn * np.rint((phases[k] - slope * fringes) / turn)
    weights = sum(p * np.float32(t * t) for p, t in zip(powers, densities, strict=True))
    omega = sum(p * a * np.float32(t) for p, a, t in zip(powers, absolute, densities, strict=True)) / weights
    left = sum(p * (a - omega * t) ** 2 for p, a, t in zip(powers, absolute, densities, strict=True))
    total = sum(powers)
    residual = np.sqrt(left / total)
    found = (omega, np.sqrt(total / len(densities)), residual)
    return tuple(np.asarray(one, dtype=np.float64).reshape(rows, columns) for one in found)  # type: ignore[return-value]


def matched_by_opencv(
    pair: NDArray[np.uint16], x: NDArray[Any], y: NDArray[Any], radius: int, rounds: int, gain: float
) -> Floats:
    """Return the displacement of subsets, (n, 2) in px, by OpenCV's affine enhanced correlation coefficient.

    Each starts from no displacement, and ends after `rounds` iterations or when the coefficient grows by less
    than `gain`; NaN where it does not converge. OpenCV interpolates linearly.

    Parameters
    ----------
    pair
        (2, rows, columns).
    x, y
        (n,), middles of the subsets, `radius` px and some more from the border.
    """
    ends = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, rounds, gain)
    first, second = pair.astype(np.float32)
    found = np.full((len(x), 2), np.nan)
    reach = radius + _MARGIN_PX
    for k, (column, row) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        subset = first[row - radius : row + radius + 1, column - radius : column + radius + 1]
        about = second[row - reach : row + reach + 1, column - reach : column + reach + 1]
        start = np.array([[1.0, 0.0, _MARGIN_PX], [0.0, 1.0, _MARGIN_PX]], np.float32)
        try:
            _, warp = cv2.findTransformECC(
                subset, about, start, cv2.MOTION_AFFINE, ends, np.ones_like(about, np.uint8), 1
            )
        except cv2.error:
            continue
        middle = np.array([radius, radius, 1.0])
        found[k] = warp @ middle - reach
    return found
