"""How the modulation falls with the fringe density, from the frames themselves.

A lens, a projector out of focus and the size of a pixel blur the fringes: the light of a pixel has phase
gradients that are spread about their mean with a variance p, and the fringes of density t lose the part
1 - exp(-p t^2 / 2) of their modulation. Ranging that does not know it takes the fall for the beat of two
returns close to each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.phase.fourier_domain_ranging import range_returns
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.modulation import modulation_transfer
from sms_jobs.metrology.phase.ranging.signal import ranging_sequence

_MISFIT = 1.5  # chi-square a value that a single blurred return may have; of 126 values it scatters by 0.13
_LEAST_SIGNAL = 10.0  # modulation over noise of the pixels that are asked
_FEWEST = 30  # pixels: their median is good to a fifth of what one knows


def blur_variance(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    steps: int,
    camera: GreyLevels,
    *,
    threads: int = 1,
) -> float | None:
    """Return p, the variance of omega inside a pixel in rad^2, typical of the pixels with a single return.

    Parameters
    ----------
    frames
        (frames, rows, columns) of one orientation; a sample of an image, as from `sampled`, is enough.
    densities, steps, camera, threads
        As of `range_returns`.

    Returns
    -------
    The median over the pixels whose signal is a exp(-p t^2 / 2) exp(i omega t) within noise; None where there
    are fewer than 30 of them. Pixels with several returns are no such.

    Notes
    -----
    ln Re[z exp(-i omega t)] = ln a - p t^2 / 2 by least squares with the weights (Re ..)^2, which are those
    of the logarithm's noise.
    """
    found = range_returns(frames, densities, steps, camera, threads=threads)
    noise = np.sqrt(camera.variance(found.mean_intensity))
    bright = (found.count > 0) & (found.modulation > _LEAST_SIGNAL * noise)
    bright &= (frames < camera.full_scale).all(axis=0)
    if bright.sum() < _FEWEST:
        return None
    sequence = ranging_sequence(densities, steps, len(frames))
    t, table = sequence.densities, sequence.frames
    levels = frames[:, bright].astype(np.float64)
    z = np.zeros((sequence.count, levels.shape[1]), complex)
    np.add.at(z, table[:, 0].astype(int), (table[:, 1] + 1j * table[:, 2])[:, None] * levels)
    z *= np.exp(-1j * t[:, None] * found.omega[0, bright])
    strength = np.maximum(z.real, 0.1 * found.modulation[bright])
    squares = 0.5 * (t * t)[:, None]
    weight = strength * strength
    mean = np.sum(weight * squares, axis=0) / weight.sum(axis=0)
    fall = np.sum(weight * (squares - mean) * np.log(strength), axis=0)
    p = -fall / np.sum(weight * (squares - mean) ** 2, axis=0)
    amplitude = np.exp(np.sum(weight * (np.log(strength) + p * squares), axis=0) / weight.sum(axis=0))
    misfit = np.sum(np.abs(z - amplitude * np.exp(-p * squares)) ** 2 * sequence.precision[:, None], axis=0)
    misfit /= 2.0 * sequence.count * 2.0 / steps * noise[bright].astype(np.float64) ** 2
    single = misfit < _MISFIT
    return max(float(np.median(p[single])), 0.0) if single.sum() >= _FEWEST else None


def transfer_of_sample(
    frames: NDArray[Any],
    densities: tuple[float, ...],
    steps: int,
    camera: GreyLevels,
    *,
    threads: int = 1,
) -> Floats:
    """Return the modulation at each density relative to that at t = 0, exp(-p t^2 / 2), (densities,).

    From pixels with a single return where there are some, else from the mean power of all pixels, which
    close returns make too steep; 1 where nothing is lit. Parameters as of `blur_variance`.
    """
    p = blur_variance(frames, densities, steps, camera, threads=threads)
    t = np.array(densities, dtype=np.float64)
    if p is not None:
        return np.asarray(np.exp(-0.5 * p * t * t))
    try:
        return modulation_transfer(frames, densities, steps, camera)
    except MeasurementFailed:
        return np.ones(t.size)
