"""What is the same for all pixels that are ranged, and the tests that every way of fitting shares."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.phase.ranging.start import Grid

Floats: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

JOINT, MODULUS, ORIGINAL = 1, 2, 4  # bits of the mode

_TRIGGER = 0.85  # of the threshold, for a peak that is seen between samples


class Plan(NamedTuple):
    """What is the same for all pixels.

    `first` is t of the first density, `least` the number of densities that a pixel needs; `turns`, `order`
    are of `twiddles` and `bit_reversal`, `weights` and `sums` of `fit_weights` for unsaturated pixels,
    `overlaps` of `overlap_table`, `grid` of `grid`. `variance` is that of z at grey level 0, `slope` its
    growth a grey level, and `unit` makes the standard deviation of a frame of that of z.
    """

    first: int
    least: int
    mode: int
    refinements: int
    threshold: float
    variance: float
    slope: float
    unit: float
    turns: Single
    order: NDArray[np.int64]
    weights: Single
    sums: Floats
    overlaps: Floats
    grid: Grid


@kernel
def real_values(first: int, densities: int) -> float:
    """Return how many real values there are: two a density, one at t = 0."""
    return float(2 * densities - (1 if first == 0 else 0))


@kernel
def is_excessive(threshold: float, values: float, variance: float, squares: float) -> bool:
    """Tell whether what is left of a pixel is too much for noise."""
    return bool(squares - variance * values > threshold * np.sqrt(2.0 * values) * variance)


@kernel
def is_worth_a_fit(
    threshold: float, values: float, variance: float, squares: float, scatter: float, height: float
) -> bool:
    """Tell whether what is left of a pixel can hold a return: a high sample, or too much of everything."""
    floor = max(variance, squares / max(values, 1.0))
    return bool(
        height > _TRIGGER * threshold * np.sqrt(scatter * floor)
        or is_excessive(threshold, values, variance, squares)
    )
