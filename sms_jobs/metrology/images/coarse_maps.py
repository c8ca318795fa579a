"""Maps of what hardly changes from pixel to pixel: computed at few of them, and spread to the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles

MOST_BLOCKS = 64
"""Blocks along the longer side of an image."""
_MANTISSA_BITS = 9
_LOOKED_AT = 4


@dataclass(frozen=True)
class Samples:
    """One valid pixel of each block of an image that is found to have one.

    Attributes
    ----------
    rows, columns
        (n,) of the pixels.
    block_px
        Side of a block.
    valid
        (rows, columns) of the image.
    """

    rows: Ints
    columns: Ints
    block_px: int
    valid: Mask

    @property
    def pixels(self) -> tuple[Ints, Ints]:
        """Rows and columns, to index an image with."""
        return self.rows, self.columns


def sample_blocks(valid: Mask, most: int = MOST_BLOCKS) -> Samples:
    """Return, of blocks of an image (rows, columns), the valid pixel that is nearest to the middle of each.

    Of large blocks 4 to 8 pixels along a side are looked at; all, where none of those is valid anywhere.
    """
    side = max(1, -(-max(valid.shape) // most))
    step = max(1, side // _LOOKED_AT)
    rows, columns = (step * place for place in np.nonzero(valid[::step, ::step]))
    if not len(rows):
        rows, columns = np.nonzero(valid)
    across = -(-valid.shape[1] // side)
    block = (rows // side) * across + columns // side
    middle = 0.5 * (side - 1)
    away = (rows % side - middle) ** 2 + (columns % side - middle) ** 2
    order = np.lexsort((away, block))
    _, first = np.unique(block[order], return_index=True)
    chosen = order[first]
    return Samples(rows[chosen], columns[chosen], side, valid)


def spread(samples: Samples, values: Floats) -> Singles:
    """Return a map (components, rows, columns) of values (components, n) at samples; NaN where not valid.

    Values are positive. Linear between the middles of the blocks; what a block has not got is that of the
    nearest that has. Kept is one part in a thousand, which makes smooth maps small in files. NaN everywhere
    where all are NaN.
    """
    side, shape = samples.block_px, samples.valid.shape
    blocks = -(-shape[0] // side), -(-shape[1] // side)
    found = np.full((len(values), *shape), np.nan, np.float32)
    known = np.isfinite(values).all(axis=0)
    if not known.any():
        return found
    coarse = np.full((len(values), *blocks), np.nan)
    coarse[:, samples.rows[known] // side, samples.columns[known] // side] = values[:, known]
    nearest = ndimage.distance_transform_edt(np.isnan(coarse[0]), return_distances=False, return_indices=True)
    coarse = coarse[:, nearest[0], nearest[1]]
    down, along = (_weights(size, count, side) for size, count in zip(shape, blocks, strict=True))
    for k, each in enumerate(coarse):
        found[k] = _shortened((down @ each @ along.T).astype(np.float32))
    found[:, ~samples.valid] = np.nan
    return found


def _weights(size: int, count: int, side: int) -> Floats:
    """Return the weights (size, count) of the middles of blocks in linear interpolation."""
    place = np.clip((np.arange(size) - 0.5 * (side - 1)) / side, 0.0, count - 1.0)
    return np.asarray(np.maximum(1.0 - np.abs(place[:, None] - np.arange(count)), 0.0))


def _shortened(values: Singles) -> Singles:
    """Return values with so many bits of their mantissa, rounded to nearest."""
    lost = 23 - _MANTISSA_BITS
    bits = values.view(np.uint32) + np.uint32(1 << (lost - 1))
    return np.asarray((bits >> np.uint32(lost) << np.uint32(lost)).view(np.float32))
