"""An array in a sealed file, of which parts are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.archive import hdf5
from sms_jobs.archive.blocks import Checks, Grid, Part, Shape, check_of, pieces, read_part, read_whole
from sms_jobs.archive.damage import altered, readable
from sms_jobs.archive.hashing import ArrayDigest

_CHECKS = Checks()
"""Of this process, by what manifests say of the arrays: another file of the same contents has the same."""


@dataclass(frozen=True)
class StoredArray:
    """An array in a sealed file, as long as the file is open; what is read of it is what was sealed.

    Attributes
    ----------
    grid
        The blocks in which it is read and compared.
    """

    _dataset: Any
    _where: str
    grid: Grid
    _checks: Callable[[], NDArray[np.uint32]]

    @property
    def shape(self) -> Shape:
        """Lengths of its axes."""
        return self.grid.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its elements, little-endian."""
        dtype: np.dtype[Any] = self._dataset.dtype
        return dtype

    def read(self, part: Part) -> NDArray[Any]:
        """Return a part of it; one block is in memory besides.

        Raises `ArchiveCorrupt` where it is not what was sealed.
        """
        checks = self._checks()

        def compare(index: Shape, block: NDArray[Any]) -> None:
            if check_of(block) != checks[index]:
                place = ", ".join(str(one.start) for one in self.grid.bounds(index))
                raise altered(self._where, f"the block at {place} has", "other values", "their check")

        with readable(self._where):
            return read_part(self._dataset, self.grid, part, compare)

    def glance(self, part: Part) -> NDArray[Any]:
        """Return a part of it as it stands there, compared with nothing: for a first look, not for a number.

        Raises `ArchiveCorrupt` where it cannot be read.
        """
        with readable(self._where):
            return read_part(self._dataset, self.grid, part, lambda index, block: None)

    def pieces(self, part: Part) -> Iterator[NDArray[Any]]:
        """Yield a part of it piece by piece in C order; raises as `read` does."""
        for piece in pieces(part, self.grid, self.dtype.itemsize):
            yield self.read(piece)

    def block(self, index: Shape) -> NDArray[Any]:
        """Return a block, which is shorter at the end of an axis; raises as `read` does."""
        return self.read(self.grid.bounds(index))


def stored_array(dataset: Any, stated: ArrayDigest, where: str) -> StoredArray:
    """Return an array that has one hash; raises `ArchiveCorrupt`, when it is read, where that differs."""
    shape: Shape = tuple(dataset.shape)
    grid = Grid(shape, hdf5.chunk_shape(shape, dataset.dtype.itemsize, False))

    def compared() -> NDArray[np.uint32]:
        with readable(where):
            found, checks = read_whole(dataset, grid)
        if found != stated["sha256"]:
            raise altered(where, "its values hash to", f"{found[:12]}...", f"{stated['sha256'][:12]}...")
        return checks

    key = (stated["sha256"], stated["dtype"], shape)
    return StoredArray(dataset, where, grid, lambda: _CHECKS.of(key, compared))
