"""Parts of arrays, read and compared block by block: neither a reader nor its memory needs the whole.

The manifest has the CRC-32 of every block, so that a part costs the blocks that it touches, each of which is
compared with its check whenever it is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import ceil, prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

Shape: TypeAlias = tuple[int, ...]
Part: TypeAlias = tuple[slice, ...]
"""One slice for each axis, with beginning, end and a positive step that are known."""

PIECE_BYTES = 4 << 20
"""Of what `pieces` yields at a time."""


@dataclass(frozen=True)
class Grid:
    """How an array is cut into blocks, the last of an axis being shorter."""

    shape: Shape
    block: Shape

    @property
    def counts(self) -> Shape:
        """Blocks along each axis."""
        return tuple(ceil(n / b) for n, b in zip(self.shape, self.block, strict=True))

    def bounds(self, index: Sequence[int]) -> Part:
        """Return where a block lies."""
        each = zip(index, self.block, self.shape, strict=True)
        return tuple(slice(i * b, min((i + 1) * b, n), 1) for i, b, n in each)

    def touched(self, part: Part) -> Iterator[Shape]:
        """Yield the blocks that a part touches, in C order."""
        ranges = (
            range(one.start // b, ceil(one.stop / b)) if one.stop > one.start else range(0)
            for one, b in zip(part, self.block, strict=True)
        )
        yield from product(*ranges)


def block_checks(slab: NDArray[Any], block: Shape) -> NDArray[np.uint32]:
    """Return the CRC-32 of each block of a slab that begins with one, (blocks along each axis)."""
    grid = Grid(slab.shape, block)
    found = np.empty(grid.counts, np.uint32)
    for index in np.ndindex(*grid.counts):
        found[index] = check_of(slab[grid.bounds(index)])
    return found


def check_of(block: NDArray[Any], before: int = 0) -> int:
    """Return the CRC-32 of the bytes of a block in C order, after that of what came before."""
    if block.flags.c_contiguous:
        return zlib_ng.crc32(block.data, before)
    for part in block:
        before = check_of(part, before)
    return before


def read_part(
    dataset: Any, grid: Grid, part: Part, compare: Callable[[Shape, NDArray[Any]], None]
) -> NDArray[Any]:
    """Return a part of an array, each of whose blocks `compare` has seen; one block is in memory besides."""
    found = np.empty(lengths(part), dataset.dtype)
    for index in grid.touched(part):
        bounds = grid.bounds(index)
        block = dataset[bounds]
        compare(index, block)
        inside, place = [], []
        for one, bound in zip(part, bounds, strict=True):
            # The first of the part that lies in the block, and how many do.
            first = max(0, ceil((bound.start - one.start) / one.step))
            last = min(len(range(one.start, one.stop, one.step)), ceil((bound.stop - one.start) / one.step))
            begin = one.start + first * one.step - bound.start
            inside.append(slice(begin, begin + max(last - first, 0) * one.step, one.step))
            place.append(slice(first, max(last, first)))
        found[tuple(place)] = block[tuple(inside)]
    return found


def lengths(part: Part) -> Shape:
    """Return the shape of a part."""
    return tuple(len(range(one.start, one.stop, one.step)) for one in part)


def pieces(part: Part, grid: Grid, itemsize: int) -> Iterator[Part]:
    """Yield a part in pieces of some MiB, one after the other in C order.

    Where the part does not jump, a piece ends with a block, so that no block is read twice.
    """
    shape = lengths(part)
    if prod(shape) * itemsize <= PIECE_BYTES:
        yield part
        return
    axis = next(place for place, length in enumerate(shape) if length > 1)
    one, block = part[axis], grid.block[axis]
    count = max(1, PIECE_BYTES * shape[axis] // (prod(shape) * itemsize))
    start = one.start
    while start < one.stop:
        stop = start + count * one.step
        if one.step == 1 and stop - stop % block > start:
            stop -= stop % block
        taken = slice(start, min(stop, one.stop), one.step)
        yield from pieces((*part[:axis], taken, *part[axis + 1 :]), grid, itemsize)
        start = stop
