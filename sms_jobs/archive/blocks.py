"""Parts of arrays, read and compared block by block: neither a reader nor its memory needs the whole.

The manifest has one hash of a whole array, to which no part can be compared. Whoever first asks for a part
has the array read once, in blocks in C order: its hash is compared, and the CRC-32 of every block is noted in
this process, by that hash. From then on a part costs the blocks that it touches, each compared with its
check, so that an array which rots later is noticed. Frames bring the checks of their blocks along.
"""

from __future__ import annotations

import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import ceil, prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.archive.hashing import SlabHash

Shape: TypeAlias = tuple[int, ...]
Part: TypeAlias = tuple[slice, ...]
"""One slice for each axis, with beginning, end and a positive step that are known."""

PIECE_BYTES = 4 << 20
"""Of what `pieces` yields at a time."""
_MOST_TABLES = 2048


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


class Checks:
    """The checks of the blocks of arrays that were read as a whole, by what the manifest says of them."""

    def __init__(self) -> None:
        self._tables: OrderedDict[Any, NDArray[np.uint32]] = OrderedDict()
        self._making: dict[Any, threading.Lock] = {}
        self._lock = threading.Lock()

    def of(self, key: Any, make: Callable[[], NDArray[np.uint32]]) -> NDArray[np.uint32]:
        """Return the checks of an array, made where they are not known; by one thread, others wait."""
        with self._lock:
            if key in self._tables:
                self._tables.move_to_end(key)
                return self._tables[key]
            making = self._making.setdefault(key, threading.Lock())
        with making:
            with self._lock:
                known = self._tables.get(key)
            if known is None:
                known = make()
            with self._lock:
                self._tables[key] = known
                self._making.pop(key, None)
                while len(self._tables) > _MOST_TABLES:
                    self._tables.popitem(last=False)
            return known


def read_whole(dataset: Any, grid: Grid) -> tuple[str, NDArray[np.uint32]]:
    """Read an array once; return its SHA-256 and the CRC-32 of each block.

    Blocks in C order are the array in C order, as `hdf5.chunk_shape` cuts it.
    """
    hashed = SlabHash()
    checks = np.empty(grid.counts, np.uint32)
    for index in np.ndindex(*grid.counts):
        block = np.ascontiguousarray(dataset[grid.bounds(index)])
        hashed.update(block)
        checks[index] = check_of(block)
    return hashed.hexdigest(), checks


def check_of(block: NDArray[Any]) -> int:
    """Return the CRC-32 of the bytes of a block in C order."""
    return zlib.crc32(np.ascontiguousarray(block).data)


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
