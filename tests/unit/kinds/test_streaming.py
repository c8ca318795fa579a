"""Frames come slab by slab, whole and in order, and few of them are in memory."""

from __future__ import annotations

import gc
import weakref
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.kinds.shape.streaming import exposed_slabs, in_best_exposure, row_slabs, some_rows
from sms_jobs.metrology.phase.exposure import merge_exposures
from sms_jobs.records.measurement import FringeSequence, Measurement


@dataclass
class Counted:
    """A stack that knows how many of its slabs are in memory."""

    frames: NDArray[np.uint16]
    alive: int = 0
    most: int = 0
    asked: list[tuple[int, int]] = field(default_factory=list)

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.frames.shape  # type: ignore[return-value]

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.frames.dtype

    def frame(self, index: int) -> NDArray[Any]:
        return self.frames[index]

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        slab = self.frames[:, start:stop].copy()
        self.asked.append((start, stop))
        self.alive += 1
        self.most = max(self.most, self.alive)
        weakref.finalize(slab, self._gone)
        return slab

    def _gone(self) -> None:
        self.alive -= 1


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("rows", [1, 64, 65, 200])
def test_slabs_are_the_whole_stack_and_two_at_most_are_held(
    rng: np.random.Generator, rows: int, threads: int
) -> None:
    stack = Counted(rng.integers(0, 4096, (5, rows, 7), dtype=np.uint16))
    seen = []
    for slab, frames in row_slabs(stack, threads):
        seen.append(frames.copy())
        assert frames.shape == (5, slab.stop - slab.start, 7)
        del frames
    np.testing.assert_array_equal(np.concatenate(seen, axis=1), stack.frames)
    gc.collect()
    assert stack.most <= threads
    assert stack.alive == 0
    assert [start for start, _ in stack.asked] == list(range(0, rows, 64))


def test_a_failure_to_read_is_not_lost() -> None:
    class Broken(Counted):
        def rows(self, start: int, stop: int) -> NDArray[Any]:
            if start > 0:
                raise OSError("the disk is gone")
            return super().rows(start, stop)

    with pytest.raises(OSError, match="the disk is gone"):
        list(row_slabs(Broken(np.zeros((3, 100, 4), np.uint16)), 2))


def test_many_frames_make_lower_slabs() -> None:
    class Tall(Counted):
        @property
        def shape(self) -> tuple[int, int, int]:
            return 4096, 128, 2048

    heights = {
        slab.stop - slab.start for slab, _ in row_slabs(Tall(np.zeros((1, 128, 1), np.uint16)), threads=1)
    }
    assert heights == {16}


EXPOSURES = (1.0, 0.25, 4.0)


def bracketed(stack: Counted, exposures: tuple[float, ...]) -> Measurement:
    sequence = FringeSequence((1, 2), 3, (0.0,), exposures)
    white = np.zeros(stack.shape[1:], np.uint16)
    return Measurement(datetime(2026, 1, 1, tzinfo=UTC), sequence, 4000, 0.1, 2.0, white, stack)


def test_a_sample_is_spread_over_the_image() -> None:
    rows, columns = np.mgrid[0:90, 0:50].astype(np.uint16)
    found = some_rows(bracketed(Counted(np.stack([rows, columns])), (1.0,)), 3)
    np.testing.assert_array_equal(found.rows, [15, 45, 75])
    np.testing.assert_array_equal(found.frames[0, :, 0], [15, 45, 75])
    np.testing.assert_array_equal(found.pixels(10)[1, 0], np.arange(0, 50, 5))
    np.testing.assert_array_equal(found.pixels(80), found.frames)


@pytest.mark.parametrize(
    ("height", "starts"), [(128, [16, 48, 80, 112]), (100, [12, 37, 62, 87]), (9, [1, 5]), (2, [0])]
)
def test_rows_of_a_sample_lie_beside_each_other(height: int, starts: list[int]) -> None:
    """And are read at once, no row twice, however low the image is."""
    stack = Counted(np.arange(height, dtype=np.uint16)[None, :, None])
    found = some_rows(bracketed(stack, (1.0,)), 16, beside=4)
    assert [start for start, _ in stack.asked] == starts
    wanted = [row for start in starts for row in range(start, min(start + 4, height))]
    assert found.rows.tolist() == found.frames[0, :, 0].tolist() == wanted
    assert len(set(wanted)) == len(wanted)
    few = found.thinned(4)
    assert few.rows.tolist() == few.frames[0, :, 0].tolist() == wanted[:: max(len(wanted) // 4, 1)]


def test_a_sample_has_the_best_exposure_of_each_pixel(rng: np.random.Generator) -> None:
    stack = Counted(rng.integers(0, 4096, (18, 40, 7), dtype=np.uint16))
    recorded = bracketed(stack, EXPOSURES)
    best, _ = in_best_exposure(recorded, stack.frames)
    found = some_rows(recorded, 8, beside=2)
    np.testing.assert_array_equal(found.frames, best[:, found.rows])


def test_a_sample_has_no_row_twice_and_none_beyond_the_image() -> None:
    for height in range(1, 200):
        stack = Counted(np.zeros((1, height, 1), np.uint16))
        rows = some_rows(bracketed(stack, (1.0,)), 32, beside=4).rows.tolist()
        assert len(set(rows)) == len(rows) == (min(height, 32) // 4 * 4 or height), height
        assert set(rows) <= set(range(height)), height


@pytest.mark.parametrize("height", [512, 1024, 2048, 4096])
def test_a_group_of_rows_is_read_from_one_chunk(height: int) -> None:
    stack = Counted(np.zeros((1, height, 1), np.uint16))
    some_rows(bracketed(stack, (1.0,)), 32, beside=4)
    # An archive's chunks have 64 rows.
    assert [start // 64 for start, _ in stack.asked] == [(stop - 1) // 64 for _, stop in stack.asked]


@pytest.mark.parametrize("threads", [1, 2])
def test_the_best_exposures_slab_by_slab_are_those_of_the_whole(
    rng: np.random.Generator, threads: int
) -> None:
    stack = Counted(rng.integers(0, 4096, (18, 150, 7), dtype=np.uint16))
    stack.frames[:6, ::2] //= 2
    stack.frames[6:12, 1::2] //= 2
    wanted, index = merge_exposures(stack.frames.reshape(3, 6, 150, 7), EXPOSURES, 4000)
    seen, chosen = [], []
    for slab, frames, exposure in exposed_slabs(bracketed(stack, EXPOSURES), threads):
        assert slab.stop - slab.start == frames.shape[1]
        seen.append(frames.copy())
        chosen.append(exposure)
        del frames
        gc.collect()
    np.testing.assert_array_equal(np.concatenate(seen, axis=1), wanted)
    np.testing.assert_array_equal(np.concatenate(chosen), np.array(EXPOSURES, np.float32)[index])
    assert len(np.unique(index)) == 3
    assert stack.most <= 2


def test_a_single_exposure_is_not_copied(rng: np.random.Generator) -> None:
    stack = Counted(rng.integers(0, 4096, (6, 20, 7), dtype=np.uint16))
    frames, exposure = in_best_exposure(bracketed(stack, (0.5,)), stack.frames)
    assert frames is stack.frames
    np.testing.assert_array_equal(exposure, np.full((20, 7), 0.5, np.float32))
