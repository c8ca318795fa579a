"""Whole rows and columns of all frames: what borders of stripes are looked for along."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Mask

_LINES = (8, 32)  # of either direction, at least and at most
_PX_A_LINE = 8


class FrameLines:
    """Whole rows and columns of all frames, spread over the image, from slabs of rows as they come by."""

    def __init__(self, rows: int, columns: int) -> None:
        self._rows, self._columns = (_spread(length) for length in (rows, columns))
        self._height, self._width = rows, columns
        self._along: list[NDArray[Any]] = []
        self._down: list[NDArray[Any]] = []

    def take(self, rows: slice, frames: NDArray[Any]) -> None:
        """Keep what lies in a slab (frames, rows, columns)."""
        inside = self._rows[(self._rows >= rows.start) & (self._rows < rows.stop)] - rows.start
        self._along.append(frames[:, inside])
        self._down.append(frames[:, :, self._columns])

    def stacked(self) -> tuple[NDArray[Any], Mask]:
        """Return the lines one after the other, (frames, pixels), and which pixels begin one, (pixels,)."""
        along, down = (np.concatenate(parts, axis=1) for parts in (self._along, self._down))
        lines = [along, np.swapaxes(down, 1, 2)]
        starts = []
        for one in lines:
            begins = np.zeros(one.shape[1:], np.bool_)
            begins[:, 0] = True
            starts.append(begins.ravel())
        return np.concatenate([one.reshape(len(one), -1) for one in lines], axis=1), np.concatenate(starts)


def _spread(length: int) -> NDArray[np.intp]:
    count = min(int(np.clip(length // _PX_A_LINE, *_LINES)), length)
    return np.asarray(length * (2 * np.arange(count) + 1) // (2 * count))
