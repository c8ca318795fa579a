"""The camera's noise, as phase-stepped frames show it by themselves.

The steps of every density have one mean, whatever the texture is; how the means of two densities differ is
noise. Where there is one density only, the frames' departure from a sinusoid has to serve, which takes at
least four steps and counts the harmonics of the projector as noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.phase.phase_stepping import stepping_weights

_BINS = 12
_LEAST = 400  # pixels of a bin: a standard deviation from their median is good to 6 %
_MEDIAN_OF_SQUARE = 0.4549  # of a standard normal variable


@dataclass(frozen=True)
class FrameNoise:
    """Noise model of a camera in grey levels: variance = read_noise^2 + gain * grey level."""

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
    of a bin of grey levels is the median square over 0.4549, which motion and edges hardly change.
    """
    groups, steps, rows, columns = frames.shape
    if groups < 2 and steps < 4:
        return None
    levels = frames.reshape(groups, steps, rows * columns)
    levels = levels[:, :, levels.max(axis=(0, 1)) < full_scale].astype(np.float64)
    mean = levels.mean(axis=(0, 1))
    if groups > 1:
        # The difference of two means of q frames has the variance 2 sigma^2 / q.
        differences = np.diff(levels.mean(axis=1), axis=0) * np.sqrt(0.5 * steps)
    else:
        cosine, sine = (np.tensordot(w, levels[0], 1) for w in stepping_weights(steps))
        angles = 2.0 * np.pi * np.arange(steps)[:, None] / steps
        fit = mean + cosine * np.cos(angles) - sine * np.sin(angles)
        # Three numbers are fitted to q frames.
        differences = (levels[0] - fit) * np.sqrt(steps / (steps - 3.0))
    return _line(mean, np.square(differences))


def _line(mean: NDArray[np.float64], squares: NDArray[np.float64]) -> FrameNoise | None:
    """Fit the variance as a line over the grey level, neither of whose coefficients is negative."""
    edges = np.unique(np.quantile(mean, np.linspace(0.0, 1.0, _BINS + 1))) if mean.size else np.empty(0)
    level, variance = [], []
    for low, high in pairwise(edges):
        inside = (mean >= low) & (mean < high)
        if inside.sum() >= _LEAST:
            level.append(mean[inside].mean())
            variance.append(np.median(squares[:, inside]) / _MEDIAN_OF_SQUARE)
    if not level:
        return None
    x, y = np.array(level), np.array(variance)
    # Relative errors of the bins are alike, so each is weighted by its own variance.
    weight = 1.0 / np.maximum(y, 1.0 / 12.0)
    gain, floor = 0.0, float(np.average(y, weights=weight**2))
    if x.size > 1:
        slope, start = np.polyfit(x, y, 1, w=weight)
        if slope > 0.0:
            through = float(np.sum(weight**2 * x * y) / np.sum(weight**2 * x * x))
            gain, floor = (float(slope), float(start)) if start >= 0.0 else (through, 0.0)
    # Whole grey levels alone make a variance of 1/12.
    return FrameNoise(gain, float(np.sqrt(max(floor, 1.0 / 12.0))))
