"""E57: the points of one view with their pixel and grey; positions in metres, as the standard demands.

ASTM E2807 is public, and of it a file with one view needs little: pages of 1024 bytes with a checksum each,
one section of packets with the columns side by side, and an XML text that describes both.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import Exporter, PointGrid, grey

_METRES = 1e-3
_NO_TEXTURE = 0.5
_PAGE = 1024
_IN_PAGE = 1020  # the rest is the checksum
_PAGES_AT_ONCE = 256
_HEADER_BYTES = 48
_SECTION_BYTES = 32
_COLUMNS = ("<f8", "<f8", "<f8", "<f4", "<u2", "<u2")  # x, y, z, intensity, row, column
_RECORD_BYTES = 32
_IN_PACKET = 2000  # 64,000 bytes of at most 65,536
_POLYNOMIAL = 0x82F63B78  # CRC-32C, reflected
_LARGEST_INDEX = 65_535


def _checksum_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> np.uint32(1)) ^ np.uint32(_POLYNOMIAL), table >> np.uint32(1))
    return table


_TABLE = _checksum_table()


def _with_checksums(logical: bytes) -> bytes:
    """Return whole pages with their CRC-32C behind them, most significant byte first."""
    pages = np.frombuffer(logical, np.uint8).reshape(-1, _IN_PAGE)
    crc = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages.T:
        crc = _TABLE[(crc ^ column) & np.uint32(0xFF)] ^ (crc >> np.uint32(8))
    sealed = np.empty((len(pages), _PAGE), np.uint8)
    sealed[:, :_IN_PAGE] = pages
    sealed[:, _IN_PAGE:] = (~crc).astype(">u4").view(np.uint8).reshape(-1, 4)
    return sealed.tobytes()


def _physical(logical: int) -> int:
    """Return the place in the file of a byte of what lies between the checksums."""
    return logical // _IN_PAGE * _PAGE + logical % _IN_PAGE


def _write_pages(parts: Iterator[bytes], file: BinaryIO) -> None:
    waiting = bytearray()
    whole = _PAGES_AT_ONCE * _IN_PAGE
    for part in parts:
        waiting += part
        while len(waiting) >= whole:
            file.write(_with_checksums(bytes(waiting[:whole])))
            del waiting[:whole]
    waiting += bytes(-len(waiting) % _IN_PAGE)
    file.write(_with_checksums(bytes(waiting)))


def _packets(columns: list[NDArray[Any]]) -> Iterator[bytes]:
    """Yield data packets: the columns of some records, one behind the other."""
    for start in range(0, len(columns[0]), _IN_PACKET):
        streams = [
            column[start : start + _IN_PACKET].astype(kind).tobytes()
            for column, kind in zip(columns, _COLUMNS, strict=True)
        ]
        sizes = struct.pack(f"<{len(streams)}H", *map(len, streams))
        body = struct.pack("<H", len(streams)) + sizes + b"".join(streams)
        length = 4 + len(body)
        padded = length + -length % 4
        yield struct.pack("<BBH", 1, 0, padded - 1) + body + bytes(padded - length)


def _packed_bytes(records: int) -> int:
    """Return the size of all data packets."""
    overhead = 6 + 2 * len(_COLUMNS)
    sizes = [_IN_PACKET] * (records // _IN_PACKET) + [records % _IN_PACKET] * (records % _IN_PACKET > 0)
    return sum(overhead + _RECORD_BYTES * n + -(overhead + _RECORD_BYTES * n) % 4 for n in sizes)


def _description(columns: list[NDArray[Any]], shape: tuple[int, int]) -> bytes:
    """Return the XML text; identifiers follow from the points, so that the same points give the same file."""
    low, high = ([float(f(column)) for column in columns[:3]] for f in (np.min, np.max))
    name = ",".join(f"{value!r}" for value in (*low, *high, len(columns[0])))
    bounds = "".join(
        f'<{axis}{end} type="Float">{value!r}</{axis}{end}>'
        for axis, *ends in zip("xyz", low, high, strict=True)
        for end, value in zip(("Minimum", "Maximum"), ends, strict=True)
    )
    integers = "".join(
        f'<{part}Minimum type="Integer">0</{part}Minimum>'
        f'<{part}Maximum type="Integer">{size - 1}</{part}Maximum>'
        for part, size in zip(("row", "column"), shape, strict=True)
    )
    prototype = (
        "".join(f'<cartesian{axis} type="Float"/>' for axis in "XYZ")
        + '<intensity type="Float" precision="single" minimum="0" maximum="1"/>'
        + "".join(
            f'<{part}Index type="Integer" minimum="0" maximum="{_LARGEST_INDEX}"/>'
            for part in ("row", "column")
        )
    )
    file_id, scan_id = (f"{{{uuid.uuid5(uuid.NAMESPACE_OID, part + name)}}}" for part in ("file", "scan"))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<e57Root type="Structure" xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0">'
        '<formatName type="String">ASTM E57 3D Imaging Data File</formatName>'
        f'<guid type="String">{file_id}</guid>'
        '<versionMajor type="Integer">1</versionMajor><versionMinor type="Integer">0</versionMinor>'
        '<data3D type="Vector" allowHeterogeneousChildren="1"><vectorChild type="Structure">'
        f'<guid type="String">{scan_id}</guid><name type="String">surface</name>'
        f'<indexBounds type="Structure">{integers}</indexBounds>'
        '<intensityLimits type="Structure"><intensityMinimum type="Float">0</intensityMinimum>'
        '<intensityMaximum type="Float">1</intensityMaximum></intensityLimits>'
        f'<cartesianBounds type="Structure">{bounds}</cartesianBounds>'
        f'<points type="CompressedVector" fileOffset="{_physical(_HEADER_BYTES)}" '
        f'recordCount="{len(columns[0])}"><prototype type="Structure">{prototype}</prototype>'
        '<codecs type="Vector" allowHeterogeneousChildren="1"></codecs></points>'
        '</vectorChild></data3D><images2D type="Vector" allowHeterogeneousChildren="1"></images2D></e57Root>'
    ).encode()


def write(grid: PointGrid, path: Path) -> None:
    """Write the points of a view that have a position, in double precision; texture as intensity, 0 .. 1.

    Raises `InvalidInput` for an image of more than 65,536 rows or columns, and for positions in pixels.
    """
    if grid.unit != "mm":
        raise InvalidInput(
            f"positions are in {grid.unit} and E57 holds metres: give the size of a pixel, "
            "for example plane.mm_per_px=0.05, or choose another format"
        )
    known = grid.valid()
    if max(known.shape) > _LARGEST_INDEX + 1:
        raise InvalidInput(f"an image of {known.shape[1]} x {known.shape[0]} px is more than 65,536 px wide")
    texture = np.full(known.shape, _NO_TEXTURE) if grid.texture is None else grey(grid.texture)
    row, column = np.nonzero(known)
    columns = [*(grid.xyz[:, known] * _METRES), texture[known], row, column]
    section = _SECTION_BYTES + _packed_bytes(len(row))
    xml_at = _HEADER_BYTES + section
    text = _description(columns, (known.shape[0], known.shape[1]))
    pages = -(-(xml_at + len(text)) // _IN_PAGE)

    def parts() -> Iterator[bytes]:
        yield struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, pages * _PAGE, _physical(xml_at), len(text), _PAGE)
        first = _physical(_HEADER_BYTES + _SECTION_BYTES)
        yield struct.pack("<B7xQQQ", 1, section, first, 0)
        yield from _packets(columns)
        yield text

    with path.open("wb") as file:
        _write_pages(parts(), file)


EXPORTER = Exporter(
    "e57", "E57 with pixel and grey of each point, in metres", ".e57", "model/e57", write, (PointGrid,)
)
