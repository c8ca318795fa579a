"""The camera's noise, as phase-stepped frames show it by themselves.

The steps of every density have one mean, whatever the texture is; how the means of two densities differ is
noise. Where there is one density only, the frames' departure from a sinusoid has to serve, which takes at
least four steps and counts harmonics of the projector as noise. Sums of grey levels are whole numbers: their
variance is taken as that of such, see `rounded_noise`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.images.rounded_noise import variance_of_rounded
from sms_jobs.metrology.phase.phase_stepping import stepping_weights

_BINS = 12
_LEAST = 400  # pixels of a bin: a standard deviation from them is good to 4 %
_LEAST_SWING = 4  # grey levels that a pixel's frames span: rounding is no noise where all are rounded alike
_FINE = 1.0 / 16.0  # of a grey level, for what is no whole number
_CUT_OFF = 2.0  # deviations above 0 from which on hardly any noise is lost where a camera's levels end


@dataclass(frozen=True)
class FrameNoise:
    """Noise model of a camera in grey levels: variance = read_noise^2 + gain * grey level.

    The noise is that of recorded frames: rounding to whole grey levels is part of it, 1/12 of variance.
    """

    gain: float
    read_noise: float


def noise_of_steps(frames: NDArray[Any], full_scale: int) -> FrameNoise | None:
    """Estimate gain and read noise from phase-stepped frames.

    Parameters
    ----------
    frames
        (groups, steps, rows, columns): the steps of each orientation and density, in any number of groups.
    full_scale
        Pixels that reach it in any frame are left out.

    Returns
    -------
    None where one group of three steps leaves nothing to compare, or too few pixels are usable. The variance
    of a bin of grey levels is taken within three standard deviations, which motion and edges hardly change.
    """
    groups, steps, rows, columns = frames.shape
    if groups < 2 and steps < 4:
        return None
    levels = frames.reshape(groups, steps, rows * columns)
    highest, lowest = levels.max(axis=(0, 1)), levels.min(axis=(0, 1))
    levels = levels[:, :, (highest < full_scale) & (highest >= lowest + _LEAST_SWING)].astype(np.int64)
    mean = levels.mean(axis=(0, 1))
    if groups > 1:
        # Two sums of q frames differ by 2 q variances.
        return _line(mean, np.diff(levels.sum(axis=1), axis=0), 2.0 * steps, 1.0)
    if steps % 2 == 0:
        # Sums with changing sign have none of the mean and none of the fringe.
        return _line(mean, levels[:, ::2].sum(axis=1) - levels[:, 1::2].sum(axis=1), float(steps), 1.0)
    cosine, sine = (np.tensordot(w, levels[0], 1) for w in stepping_weights(steps))
    angles = 2.0 * np.pi * np.arange(steps)[:, None] / steps
    fit = mean + cosine * np.cos(angles) - sine * np.sin(angles)
    # Three numbers are fitted to q frames.
    return _line(mean, levels[0] - fit, (steps - 3.0) / steps, _FINE)


def _line(
    mean: NDArray[np.float64], differences: NDArray[Any], variances: float, step: float
) -> FrameNoise | None:
    """Fit the variance as a line over the grey level, neither of whose coefficients is negative.

    The differences, (any, pixels), are multiples of a step, and vary by so many variances of a frame.
    """
    bins = min(mean.size // _LEAST, _BINS)
    level, variance = [], []
    for low, high in pairwise(_edges(mean, bins) if bins else ()):
        inside = (mean >= low) & (mean < high)
        if inside.sum() >= 0.5 * _LEAST:  # fewer only where many have one level
            level.append(mean[inside].mean())
            variance.append(variance_of_rounded(differences[:, inside], step) / variances)
    if not level:
        return None
    x, y = np.array(level), np.array(variance)
    least, whole = 1.0 / 12.0, x > _CUT_OFF * np.sqrt(y)
    if 1 < np.count_nonzero(whole) < x.size:
        # What is left of the noise where levels end at 0 is less than there is, and the least there can be.
        least, x, y = max(least, float(y[~whole].min())), x[whole], y[whole]
    # Relative errors of the bins are alike, so each is weighted by its own variance.
    weight = 1.0 / np.maximum(y, 1.0 / 12.0)
    gain, floor = 0.0, float(np.average(y, weights=weight**2))
    if x.size > 1:
        slope, start = np.polyfit(x, y, 1, w=weight)
        if slope > 0.0:
            through = float(np.sum(weight**2 * x * y) / np.sum(weight**2 * x * x))
            gain, floor = (float(slope), float(start)) if start >= 0.0 else (through, 0.0)
    # Whole grey levels alone make a variance of 1/12.
    return FrameNoise(gain, float(np.sqrt(max(floor, least))))


def _edges(mean: NDArray[np.float64], bins: int) -> NDArray[np.float64]:
    """Return the edges of bins of as many pixels each, divided where the level doubles.

    Otherwise one would hold a dark background and the rim of what is lit, with the noise of the former and
    the mean level of both.
    """
    quantiles = np.quantile(mean, np.linspace(0.0, 1.0, bins + 1))
    doubled = 2.0 ** np.arange(16)
    inside = (doubled > quantiles[0]) & (doubled < quantiles[-1])
    return np.unique(np.concatenate([quantiles, doubled[inside]]))
