"""Packed grey levels: golden bytes, bit by bit, and against the program of the standard's body."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault
from sms_jobs.instruments.codecs.pixel_formats import BITS, bytes_of, unpacked


def packed(levels: list[int], pixel_format: str) -> NDArray[np.uint8]:
    """Pack grey levels bit by bit, slowly."""
    bits = BITS[pixel_format]
    if pixel_format.endswith("Packed"):
        out = []
        for first, second in zip(levels[::2], [*levels[1::2], 0], strict=False):
            low = bits - 8
            middle = first & (2**low - 1) | (second & (2**low - 1)) << 4
            out += [first >> low, middle, second >> low]
        return np.array(out[: bytes_of(pixel_format, len(levels))], np.uint8)
    each = bits if pixel_format.endswith("p") else (8 if bits == 8 else 16)
    stream = [level >> bit & 1 for level in levels for bit in range(each)]
    stream += [0] * (-len(stream) % 8)
    eights = np.array(stream).reshape(-1, 8)
    return np.array((eights << np.arange(8)).sum(axis=1), np.uint8)


GOLDEN = [  # packed by hand after the drawings of PFNC and GigE Vision
    ("Mono12Packed", [0x123, 0xABC], "12c3ab"),
    ("Mono12p", [0x123, 0xABC], "23c1ab"),
    ("Mono10Packed", [0x123, 0x2BC], "4803af"),
    ("Mono10p", [0x123, 0x2BC, 0x000, 0x3FF], "23f10ac0ff"),
    ("Mono12", [0x123, 0xABC], "2301bc0a"),
]


@pytest.mark.parametrize(("pixel_format", "levels", "sent"), GOLDEN, ids=[g[0] for g in GOLDEN])
def test_golden_bytes(pixel_format: str, levels: list[int], sent: str) -> None:
    data = np.frombuffer(bytes.fromhex(sent), np.uint8)
    assert unpacked(data, pixel_format, len(levels), 1).tolist() == [levels]
    np.testing.assert_array_equal(packed(levels, pixel_format), data)


@pytest.mark.parametrize("pixel_format", BITS)
@pytest.mark.parametrize(("columns", "rows"), [(8, 4), (7, 3), (1, 1), (5, 2)])
def test_what_is_packed_is_unpacked(
    pixel_format: str, columns: int, rows: int, rng: np.random.Generator
) -> None:
    levels = rng.integers(0, 2 ** BITS[pixel_format], (rows, columns))
    data = packed(levels.ravel().tolist(), pixel_format)
    assert data.size == bytes_of(pixel_format, columns * rows)
    image = unpacked(np.concatenate([data, data]), pixel_format, columns, rows)
    np.testing.assert_array_equal(image, levels)
    assert image.dtype == (np.uint8 if BITS[pixel_format] == 8 else np.uint16)
    with pytest.raises(DeviceFault, match=rf"{pixel_format} has {data.size} bytes, and {data.size - 1} came"):
        unpacked(data[:-1], pixel_format, columns, rows)


def test_an_image_does_not_change_with_the_buffer_that_it_came_in() -> None:
    data = np.arange(12, dtype=np.uint8)
    images = {name: unpacked(data, name, 2, 2) for name in BITS}
    before = {name: image.copy() for name, image in images.items()}
    data[:] = 0
    for name, image in images.items():
        np.testing.assert_array_equal(image, before[name])


@pytest.mark.skipif(sys.platform != "linux", reason="harvesters is installed for the tests on Linux alone")
@pytest.mark.parametrize("pixel_format", [name for name in BITS if name != "Mono14"])
def test_the_program_of_the_standards_body_agrees(pixel_format: str, rng: np.random.Generator) -> None:
    from harvesters.util.pfnc import Dictionary

    data = rng.integers(0, 256, bytes_of(pixel_format, 120), dtype=np.uint8)
    if BITS[pixel_format] > 8 and not pixel_format.endswith(("p", "Packed")):
        data[1::2] &= 2 ** (BITS[pixel_format] - 8) - 1  # the bits above are 0
    theirs = Dictionary.get_proxy(symbolic=pixel_format).expand(data)
    np.testing.assert_array_equal(unpacked(data, pixel_format, 120, 1)[0], np.ravel(theirs))
