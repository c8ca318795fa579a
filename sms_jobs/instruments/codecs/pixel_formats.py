"""Grey levels as cameras send them, packed or not, by the names of the Pixel Format Naming Convention."""

from __future__ import annotations

from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault

BITS = {
    "Mono8": 8,
    "Mono10": 10,
    "Mono12": 12,
    "Mono14": 14,
    "Mono16": 16,
    "Mono10p": 10,
    "Mono12p": 12,
    "Mono10Packed": 10,
    "Mono12Packed": 12,
}
"""How many bits of a grey level each format has."""

_GROUPS = {"Mono10p": (4, 5), "Mono12p": (2, 3), "Mono10Packed": (2, 3), "Mono12Packed": (2, 3)}
"""How many pixels share how many bytes, where they do."""


def bytes_of(pixel_format: str, pixels: int) -> int:
    """Return how many bytes so many pixels take."""
    if pixel_format in _GROUPS:
        together, length = _GROUPS[pixel_format]
        return ceil(pixels * length / together)
    return pixels * (1 if BITS[pixel_format] == 8 else 2)


def unpacked(data: NDArray[np.uint8], pixel_format: str, columns: int, rows: int) -> NDArray[Any]:
    """Return an image from the bytes that a camera sent, line after line without gaps.

    Parameters
    ----------
    data
        Bytes; more than the image takes are ignored.
    pixel_format
        One of `BITS`.

    Returns
    -------
    (rows, columns), uint8 or uint16, in memory of its own.

    Raises
    ------
    DeviceFault
        When there are too few bytes.

    Notes
    -----
    Formats that end with p fill bytes from their lowest bit (GenICam PFNC); those that end with
    Packed are of GigE Vision: two pixels in three bytes, their lowest bits in the middle one.
    """
    pixels = columns * rows
    expected = bytes_of(pixel_format, pixels)
    if data.size < expected:
        raise DeviceFault(
            f"an image of {columns} x {rows} pixels {pixel_format} has {expected} bytes, and {data.size} "
            "came: check the camera's region of interest and pixel format"
        )
    data = data[:expected]
    if pixel_format == "Mono8":
        return data.reshape(rows, columns).copy()
    if pixel_format not in _GROUPS:
        return data.view("<u2").reshape(rows, columns).astype(np.uint16)
    together, length = _GROUPS[pixel_format]
    groups = ceil(pixels / together)
    padded = np.zeros(groups * length, np.uint8)
    padded[:expected] = data
    b = padded.reshape(groups, length).astype(np.uint16).T
    levels = np.empty((groups, together), np.uint16)
    for place, level in enumerate(_LEVELS[pixel_format](b)):
        levels[:, place] = level
    return levels.reshape(-1)[:pixels].reshape(rows, columns)


_Words = NDArray[np.uint16]


def _mono10p(b: _Words) -> list[_Words]:
    return [
        b[0] | (b[1] & 0x03) << 8,
        b[1] >> 2 | (b[2] & 0x0F) << 6,
        b[2] >> 4 | (b[3] & 0x3F) << 4,
        b[3] >> 6 | b[4] << 2,
    ]


def _mono12p(b: _Words) -> list[_Words]:
    return [b[0] | (b[1] & 0x0F) << 8, b[1] >> 4 | b[2] << 4]


def _mono10_packed(b: _Words) -> list[_Words]:
    return [b[0] << 2 | b[1] & 0x03, b[2] << 2 | b[1] >> 4 & 0x03]


def _mono12_packed(b: _Words) -> list[_Words]:
    return [b[0] << 4 | b[1] & 0x0F, b[2] << 4 | b[1] >> 4]


_LEVELS = {
    "Mono10p": _mono10p,
    "Mono12p": _mono12p,
    "Mono10Packed": _mono10_packed,
    "Mono12Packed": _mono12_packed,
}
