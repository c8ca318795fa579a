"""Frames by slabs of rows, so that memory stays bounded whatever their number."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Ints, Singles
from sms_jobs.metrology.phase.exposure import merge_exposures
from sms_jobs.records.measurement import FrameStack, Measurement

_ROWS = 64  # as in the archive's chunks
_LEAST_ROWS = 16
_SLAB_BYTES = 192 << 20  # above which a slab is halved, though its chunks are then read twice


def row_slabs(stack: FrameStack, threads: int) -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield slabs (frames, some rows, columns) of a stack from top to bottom, and which rows they are.

    With more than one thread the next slab is read while one is worked on; then two are in memory, if the
    caller lets go of each before it asks for the next.
    """
    count, rows, columns = stack.shape
    height = _ROWS
    while height > _LEAST_ROWS and count * height * columns * stack.dtype.itemsize > _SLAB_BYTES:
        height //= 2
    slabs = [slice(start, min(start + height, rows)) for start in range(0, rows, height)]
    if threads == 1:
        for slab in slabs:
            yield slab, stack.rows(slab.start, slab.stop)
        return
    with ThreadPoolExecutor(1) as reader:
        ahead = reader.submit(stack.rows, slabs[0].start, slabs[0].stop)
        for slab, after in zip(slabs, [*slabs[1:], None], strict=True):
            frames = ahead.result()
            if after is None:
                del ahead  # it holds on to the frames
            else:
                ahead = reader.submit(stack.rows, after.start, after.stop)
            yield slab, frames


@dataclass(frozen=True)
class RowSample:
    """Some rows of a measurement, each pixel in its best exposure.

    Attributes
    ----------
    rows
        (n,): their numbers.
    frames
        (patterns, n, columns).
    """

    rows: Ints
    frames: NDArray[Any]

    def thinned(self, rows: int) -> RowSample:
        """Return every n-th of them, so that about `rows` are left, evenly spread."""
        step = max(len(self.rows) // rows, 1)
        return RowSample(self.rows[::step], self.frames[:, ::step])

    def pixels(self, columns: int) -> NDArray[Any]:
        """Return (patterns, n, about `columns`): single pixels, evenly spread."""
        return self.frames[..., :: max(self.frames.shape[2] // columns, 1)]


def some_rows(measurement: Measurement, count: int, beside: int = 1) -> RowSample:
    """Return `count` rows of a measurement, fewer of a low image, in evenly spread groups.

    So many lie `beside` each other and are read at once. They begin in the middle of their part of the image,
    and do not lie about it: of 2^n rows a chunk begins there, and two would be read.
    """
    stack = measurement.frames
    height = stack.shape[1]
    groups = max(min(count, height) // beside, 1)
    starts = [height * (2 * i + 1) // (2 * groups) for i in range(groups)]
    beyond = max(starts[-1] + beside - height, 0)
    each = [range(max(start - beyond, 0), min(start - beyond + beside, height)) for start in starts]
    frames = np.concatenate([stack.rows(rows.start, rows.stop) for rows in each], axis=1)
    return RowSample(
        np.concatenate([np.array(rows) for rows in each]), in_best_exposure(measurement, frames)[0]
    )


def in_best_exposure(measurement: Measurement, frames: NDArray[Any]) -> tuple[NDArray[Any], Singles]:
    """Return the frames of one exposure, chosen pixel by pixel among those recorded, and which it is.

    Parameters
    ----------
    measurement
        That the frames are of.
    frames
        (exposures * patterns, rows, columns), a part of its images.

    Returns
    -------
    (patterns, rows, columns), as they are where there is one exposure only; (rows, columns), the exposure in
    units of the camera's own, by which grey levels are to be divided before pixels are compared.
    """
    exposures = measurement.sequence.exposures
    if len(exposures) == 1:
        return frames, np.full(frames.shape[1:], exposures[0], np.float32)
    bracket = frames.reshape(len(exposures), -1, *frames.shape[1:])
    merged, index = merge_exposures(bracket, exposures, measurement.full_scale)
    return merged, np.array(exposures, np.float32)[index]


def exposed_slabs(measurement: Measurement, threads: int) -> Iterator[tuple[slice, NDArray[Any], Singles]]:
    """Yield slabs of the frames of each pixel's best exposure, and that exposure: see `in_best_exposure`.

    As from `row_slabs`: a slab holds fewer rows the more exposures there are, so that memory stays bounded.
    """
    for slab, frames in row_slabs(measurement.frames, threads):
        best, exposure = in_best_exposure(measurement, frames)
        del frames
        yield slab, best, exposure
        del best
