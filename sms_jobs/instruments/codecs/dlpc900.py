"""DLPC900, the controller of DLP LightCrafter 6500 projectors, by USB: commands, replies, and images.

Everything is as in the DLPC900 Programmer's Guide (Texas Instruments DLPU018): messages in reports of 64
bytes (section 1.2), patterns that are defined, loaded and played (2.4), images of 24 bits a pixel that are
compressed line by line (2.4.3). An image holds three patterns of 8 bits, from its bits 0, 8 and 16 on; the
bytes of a pixel come from the high bits down, as programs do that drive such projectors.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

REPORT_BYTES = 64
PATTERNS_AN_IMAGE = 3
MOST_IMAGES = 18
_READ, _REPLY, _FAILED = 0x80, 0x40, 0x20
_HEADER = struct.Struct("<BBHH")
_REPLY_HEADER = struct.Struct("<BBH")
_IMAGE_HEADER = struct.Struct("<4sHHI8s4xBBB21x")
_PIECE_BYTES = 504
_SIGNATURE = b"Spld"
_ENHANCED = 2
_CLEAR = 1
"""Clears a pattern after it was lit."""
_END_OF_LINE, _END_OF_IMAGE, _AS_ABOVE = b"\0\0", b"\0\1\0", b"\0\1"
LONGEST_US = 2**24 - 1


class Command(IntEnum):
    """What is asked for."""

    HARDWARE_STATUS = 0x1A0A
    MODE = 0x1A1B
    START_STOP = 0x1A24
    IMAGE = 0x1A2A
    IMAGE_DATA = 0x1A2B
    PATTERNS = 0x1A31
    ORDER = 0x1A32
    PATTERN = 0x1A34


class Hardware(IntEnum):
    """Bits of the hardware status."""

    INITIALISED = 1 << 0
    INCOMPATIBLE = 1 << 1
    ABORTED = 1 << 6
    SEQUENCER_ERROR = 1 << 7


STOP, START = b"\0", b"\2"
ON_THE_FLY = b"\3"
"""Mode in which images are loaded by USB."""


@dataclass(frozen=True)
class Reply:
    """What the controller answers.

    Attributes
    ----------
    sequence
        Of the message that it answers.
    failed
        Whether the command is not known, or was refused.
    data
        What was asked for.
    """

    sequence: int
    failed: bool
    data: bytes


@dataclass(frozen=True)
class Pattern:
    """A pattern that can be played.

    Attributes
    ----------
    index
        By which it is called.
    image, first_bit
        Where it is: in which image, and from which of its bits on.
    lit_us, dark_us
        How long it is lit, and then dark.
    bits
        Of its grey levels.
    light
        Which lights are on: red 1, green 2, blue 4.
    """

    index: int
    image: int
    first_bit: int
    lit_us: int
    dark_us: int = 0
    bits: int = 8
    light: int = 7


def grey_pattern(index: int, lit_us: int, dark_us: int) -> Pattern:
    """Return the `index`-th pattern of 8 bits of images that hold three each."""
    image, place = divmod(index, PATTERNS_AN_IMAGE)
    return Pattern(index, image, 8 * place, lit_us, dark_us)


def message(command: int, data: bytes | None, sequence: int) -> bytes:
    """Return a message that is answered; without data, one that asks for them."""
    flags = _REPLY | (_READ if data is None else 0)
    body = data or b""
    return _HEADER.pack(flags, sequence, 2 + len(body), command) + body


def reports(whole: bytes) -> list[bytes]:
    """Return the reports that a message goes by, each filled up with zeros."""
    starts = range(0, len(whole), REPORT_BYTES)
    return [whole[k : k + REPORT_BYTES].ljust(REPORT_BYTES, b"\0") for k in starts]


def reply(report: bytes) -> Reply | None:
    """Return what a report says; None where it is no reply."""
    if len(report) < _REPLY_HEADER.size:
        return None
    flags, sequence, length = _REPLY_HEADER.unpack_from(report)
    data = report[_REPLY_HEADER.size : _REPLY_HEADER.size + length]
    return Reply(sequence, bool(flags & _FAILED), data) if len(data) == length else None


def definition(pattern: Pattern) -> bytes:
    """Return what defines a pattern; it gives a pulse at the output 2 when it begins."""
    options = pattern.light << 4 | (pattern.bits - 1) << 1 | _CLEAR
    where = pattern.first_bit << 11 | pattern.image
    lit, dark = (us.to_bytes(3, "little") for us in (pattern.lit_us, pattern.dark_us))
    return struct.pack("<H3sB3sBH", pattern.index, lit, options, dark, 0, where)


def patterns(count: int) -> bytes:
    """Return what makes the definitions of so many patterns hold, repeated for ever."""
    return struct.pack("<HI", count, 0)


def order(indices: Sequence[int], *, repeated: bool) -> bytes:
    """Return which patterns are played in which order, once or for ever."""
    count = 0 if repeated else len(indices)
    return struct.pack(f"<HI{len(indices)}H", len(indices), count, *indices)


def announced(index: int, size: int) -> bytes:
    """Return what comes before an image of so many bytes is loaded; higher numbers are loaded first."""
    return struct.pack("<HI", index, size)


def pieces(image: bytes) -> list[bytes]:
    """Return what loads an image, piece by piece."""
    parts = [image[k : k + _PIECE_BYTES] for k in range(0, len(image), _PIECE_BYTES)]
    return [struct.pack("<H", len(part)) + part for part in parts]


def image(levels: NDArray[np.uint8]) -> bytes:
    """Return an image with its header, compressed.

    A line that is like the one above, or of one value, takes a few bytes; others are given as they are.

    Parameters
    ----------
    levels
        (3, rows, columns), grey levels of its patterns.
    """
    _, rows, columns = levels.shape
    pixels = np.ascontiguousarray(np.moveaxis(levels[::-1], 0, -1))  # (rows, columns, high to low bits)
    lines = [line.tobytes() for line in pixels]
    count = _count(columns)
    parts = []
    for k, line in enumerate(lines):
        if k and line == lines[k - 1]:
            parts.append(_AS_ABOVE + count)
        elif line == line[:PATTERNS_AN_IMAGE] * columns:
            parts.append(count + line[:PATTERNS_AN_IMAGE])
        else:
            parts.append(b"\0" + count + line)
    data = b"".join(part + _END_OF_LINE for part in parts) + _END_OF_IMAGE
    data += bytes(-len(data) % 4)
    size = _IMAGE_HEADER.size + len(data)
    return _IMAGE_HEADER.pack(_SIGNATURE, columns, rows, size, b"\xff" * 8, 0, _ENHANCED, 1) + data


def _count(number: int) -> bytes:
    """Return a number in one byte, or the low seven bits of it in the first of two."""
    return bytes([number]) if number < 128 else bytes([number & 127 | 128, number >> 7])
