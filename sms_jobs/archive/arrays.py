"""An array in a sealed file, of which parts are read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.archive.blocks import Grid, Part, Shape, block_checks, check_of, pieces, read_part
from sms_jobs.archive.damage import altered, differs, readable
from sms_jobs.archive.hashing import ArrayDigest, checks_in
from sms_jobs.errors import ArchiveCorrupt


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
    _checks: NDArray[np.uint32]

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

        def compare(index: Shape, block: NDArray[Any]) -> None:
            if check_of(block) != self._checks[index]:
                raise self._altered(index)

        with readable(self._where):
            return read_part(self._dataset, self.grid, part, compare)

    def whole_blocks(self, part: Part) -> NDArray[Any]:
        """Return a part that begins and ends with blocks, read at once; raises as `read` does."""
        with readable(self._where):
            slab = np.asarray(self._dataset[part])
        each = tuple(zip(part, self.grid.block, strict=True))
        first = tuple(one.start // b for one, b in each)
        checks = self._checks[tuple(slice(one.start // b, ceil(one.stop / b)) for one, b in each)]
        differ = np.argwhere(block_checks(slab, self.grid.block) != checks)
        if len(differ):
            raise self._altered(tuple(int(i) + k for i, k in zip(differ[0], first, strict=True)))
        return slab

    def whole(self) -> NDArray[Any]:
        """Return all of it, read at once; raises as `read` does."""
        return self.whole_blocks(tuple(slice(0, length, 1) for length in self.shape))

    def _altered(self, index: Shape) -> ArchiveCorrupt:
        place = ", ".join(str(one.start) for one in self.grid.bounds(index))
        return altered(self._where, f"the block at {place} has", "other values", "their check")

    def pieces(self, part: Part) -> Iterator[NDArray[Any]]:
        """Yield a part of it piece by piece in C order; raises as `read` does."""
        for piece in pieces(part, self.grid, self.dtype.itemsize):
            yield self.read(piece)

    def block(self, index: Shape) -> NDArray[Any]:
        """Return a block, which is shorter at the end of an axis; raises as `read` does."""
        return self.read(self.grid.bounds(index))


def stored_array(dataset: Any, stated: ArrayDigest, where: str) -> StoredArray:
    """Return an array of whose blocks the manifest has the checks.

    Raises `ArchiveCorrupt` where it has another type or shape than the manifest says, or these checks cannot
    be its own.
    """
    form, stated_form = [dataset.dtype.str, *dataset.shape], [stated["dtype"], *stated["shape"]]
    if form != stated_form:
        raise differs(where, form, stated_form)
    with readable(where):
        return StoredArray(dataset, where, *checks_in(stated))
