"""How the modulation of the fringes falls with their density, from the frames themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.signal import ranging_sequence, read_signal

_LEAST_SCORE = 5.0  # B over noise of the pixels that are used


def modulation_transfer(
    frames: NDArray[Any], densities: tuple[float, ...], steps: int, camera: GreyLevels
) -> Floats:
    """Estimate the modulation relative to that towards t = 0, (densities,), common to all pixels.

    Parameters
    ----------
    frames
        (frames, rows, columns) of one orientation, as of `range_returns`; a part of an image, or every n-th
        pixel of it, is enough. Saturated and dark pixels are left out.
    densities, steps, camera
        As of `range_returns`.

    Returns
    -------
    exp(-t^2 / (2 w^2)): the transfer of a Gaussian blur that is w pixels wide in omega's reciprocal; 1 where
    the modulation does not fall.

    Raises `InvalidInput` as `range_returns` does, and `MeasurementFailed` where no pixel has fringes.

    Notes
    -----
    The mean over pixels of |z|^2, less its noise, is P(t) = sum_i a_i^2 g(t)^2: what returns beat with each
    other averages out from one fringe on. w comes from a line through log P against t^2.
    """
    sequence = ranging_sequence(densities, steps, len(frames))
    rows, columns = frames.shape[1:]
    x = np.empty((sequence.count, columns), np.float32)
    y, lost = np.empty_like(x), np.empty((sequence.count + 1, columns), np.uint8)
    levels = np.empty((2, columns), np.float32)
    power, pixels, noise = np.zeros(sequence.count), 0, 0.0
    frames = np.ascontiguousarray(frames)
    for row in range(rows):
        read_signal(frames, row, sequence.frames, camera.full_scale, x, y, lost, levels)
        variance = 2.0 / steps * camera.variance(levels[0].astype(np.float64))
        used = (lost[-1] == 0) & (levels[1] ** 2 > _LEAST_SCORE**2 * variance) & (levels[1] > 0.0)
        squares = x[:, used].astype(np.float64) ** 2 + y[:, used].astype(np.float64) ** 2
        power += np.sum(squares, axis=1) - 2.0 * np.sum(variance[used])
        noise += 2.0 * float(np.sum(variance[used]))
        pixels += int(np.count_nonzero(used))
    if not pixels:
        raise MeasurementFailed(
            f"none of {rows * columns} pixels has fringes above {_LEAST_SCORE:.0f} times the noise and below "
            f"full scale: raise the exposure or give other pixels"
        )
    t = sequence.densities
    fitted = (t > 0.0) & (power > 0.0)
    weight = np.where(fitted, power / (power + noise + 1e-300), 0.0)
    log_power = np.log(np.where(fitted, power, 1.0))
    slope = np.polyfit(t * t, log_power, 1, w=weight)[0] if np.count_nonzero(fitted) > 1 else 0.0
    return np.asarray(np.exp(0.5 * min(float(slope), 0.0) * t * t))
