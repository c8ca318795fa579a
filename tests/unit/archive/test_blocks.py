"""Checks of blocks are the CRC-32 that every program knows, however a block lies in memory."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from sms_jobs.archive.blocks import block_checks, check_of

FRAMES = np.random.default_rng(3).integers(0, 4096, (5, 70, 90), dtype=np.uint16)


@pytest.mark.parametrize(
    "block",
    [FRAMES, FRAMES[1], FRAMES[:, 3:60, ::7], FRAMES[2:2], FRAMES[0, 0, :1], FRAMES.astype(np.float64)[::2]],
    ids=("whole", "frame", "scattered", "empty", "one", "every other"),
)
def test_a_check_is_the_crc_of_the_bytes_in_c_order(block: np.ndarray) -> None:
    assert check_of(block) == zlib.crc32(block.tobytes())
    assert check_of(block, 12_345) == zlib.crc32(block.tobytes(), 12_345)


def test_each_block_of_a_slab_has_its_own() -> None:
    found = block_checks(FRAMES, (2, 64, 90))
    assert found.shape == (3, 2, 1)
    assert found[2, 1, 0] == zlib.crc32(FRAMES[4:, 64:].tobytes())
