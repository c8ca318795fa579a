"""The systematic part of a map of ray gaps: means over blocks of pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints

_OUTLIER = 5.0
_FEWEST_PIXELS = 50
_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


@dataclass(frozen=True)
class GapBlocks:
    """Blocks of pixels with enough valid ones.

    Attributes
    ----------
    row, column
        (b,) of the block, in blocks.
    gap, sigma
        (b,) in mm: mean signed gap of its pixels, and that mean's standard deviation from noise.
    point
        (b, 3) in mm: mean position.
    count
        (b,) pixels.
    valid, outliers
        Number of valid pixels in the map, and of those that were left out of their block.
    """

    row: Ints
    column: Ints
    gap: Floats
    sigma: Floats
    point: Floats
    count: Ints
    valid: int
    outliers: int


def _medians(values: Floats, block: Ints, blocks: int) -> Floats:
    """Return the (upper) median of the values of each block; NaN for an empty one."""
    order = np.lexsort((values, block))
    count = np.bincount(block, minlength=blocks)
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    found = np.full(blocks, np.nan)
    some = count > 0
    found[some] = values[order][(start + count // 2)[some]]
    return found


def block_gaps(
    gap: NDArray[np.floating],
    xyz: NDArray[np.floating],
    gap_sigma: NDArray[np.floating] | None,
    block_px: int,
) -> GapBlocks:
    """Average signed gaps over blocks of pixels.

    Parameters
    ----------
    gap
        (rows, columns) in mm; NaN where invalid.
    xyz
        (3, rows, columns) in mm.
    gap_sigma
        (rows, columns) in mm, from noise; None to take the scatter within each block.
    block_px
        Side of a block.

    Notes
    -----
    Weighted by 1 / sigma^2, without pixels that are 5 standard deviations off their block's median. The
    variance of the mean is enlarged where the scatter in the block is larger than stated.
    """
    rows, columns = gap.shape
    valid = np.isfinite(gap) & np.isfinite(xyz).all(axis=0)
    if gap_sigma is not None:
        valid &= np.isfinite(gap_sigma) & (gap_sigma > 0.0)
    y, x = np.nonzero(valid)
    across = -(-columns // block_px)
    block = (y // block_px) * across + x // block_px
    blocks = across * -(-rows // block_px)
    value = gap[valid].astype(np.float64)
    off = np.abs(value - _medians(value, block, blocks)[block])
    scatter = np.maximum(_MAD * _medians(off, block, blocks), 1e-12)[block]
    sigma = scatter if gap_sigma is None else gap_sigma[valid].astype(np.float64)
    used = off <= _OUTLIER * np.maximum(sigma, scatter)

    def total(values: Floats) -> Floats:
        return np.bincount(block[used], values[used], minlength=blocks).astype(np.float64)

    count = np.bincount(block[used], minlength=blocks)
    some = count >= _FEWEST_PIXELS
    weight = 1.0 / sigma**2
    with np.errstate(invalid="ignore", divide="ignore"):
        sum_of_weights = total(weight)
        mean = total(weight * value) / sum_of_weights
        excess = total(weight * (value - mean[block]) ** 2) / (count - 1)
        variance = np.maximum(1.0, excess) / sum_of_weights
        point = np.stack([total(axis[valid].astype(np.float64)) / count for axis in xyz], axis=1)
    at = np.flatnonzero(some)
    return GapBlocks(
        at // across,
        at % across,
        mean[some],
        np.sqrt(variance[some]),
        point[some],
        count[some],
        int(valid.sum()),
        int((~used).sum()),
    )
