"""What a few frames of a recording tell of the whole, quickly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

LEAST_MODULATION_TO_NOISE = 5.0
"""Of fringes that stand out: their phase is good to 1/(5 sqrt(q/2)) rad, a fifth of a fringe never lost."""


@dataclass(frozen=True)
class RecordingQuality:
    """How well the fringes of a recording can be read.

    Attributes
    ----------
    lit_fraction
        Part of the pixels with fringes that stand out from noise, or that saturate.
    saturated_fraction
        Part of the lit pixels that are saturated in one frame or more.
    modulation
        Median amplitude of the fringes in the lit region, as a fraction of full scale; 0 where none is lit.
    """

    lit_fraction: float
    saturated_fraction: float
    modulation: float


def recording_quality(
    steps: NDArray[Any], saturated: NDArray[np.bool_], full_scale: int, gain: float, read_noise: float
) -> RecordingQuality:
    """Judge a recording by the q phase-stepped frames of one density.

    Parameters
    ----------
    steps
        (q, rows, columns), grey levels of equally spaced phase steps, or of a pattern and its inverse
        (q = 2); some of the pixels will do.
    saturated
        (rows, columns): where a frame of the recording, any, reaches full scale.
    full_scale
        Grey level at which the camera saturates.
    gain, read_noise
        Noise model in grey levels: variance = read_noise^2 + gain * level.

    Notes
    -----
    The amplitude is that of the first harmonic, 2 |sum I_k exp(-2 pi i k / q)| / q; its standard deviation is
    sigma sqrt(2 / q). Of two steps amplitude and variance are half of that.
    """
    count = len(steps)
    level = steps.astype(np.float32)
    turn = np.exp(-2j * np.pi * np.arange(count) / count).astype(np.complex64)
    share = 0.5 if count == 2 else 2.0 / count
    amplitude = share * np.abs(np.tensordot(turn, level, axes=1))
    sigma = np.sqrt((read_noise**2 + gain * level.mean(axis=0)) * share)
    lit = saturated | (amplitude > LEAST_MODULATION_TO_NOISE * sigma)
    if not lit.any():
        return RecordingQuality(0.0, 0.0, 0.0)
    return RecordingQuality(
        float(lit.mean()),
        float(saturated[lit].mean()),
        float(np.median(amplitude[lit])) / full_scale,
    )
