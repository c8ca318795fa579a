"""Triangles in the files of CAD programs: STL, PLY and OBJ, read by what their bytes can hold.

What a file says of its own size is compared with its size before anything is made room for.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Mesh: TypeAlias = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Corners, (n, 3), and triangles, (m, 3), as numbers of corners; which of them exist is not checked here."""

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex[ \t]+([^\s]{1,40})[ \t]+([^\s]{1,40})[ \t]+([^\s]{1,40})(?=\s|$)")
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER_LINES = 1000


def read_stl(content: bytes) -> Mesh:
    """Read STL of either form; a binary file is known by its size, whatever it begins with.

    Raises `ValueError`, as the other readers do, for what is no whole file of its kind.
    """
    count = int.from_bytes(content[80:84], "little")
    if len(content) >= 84 and len(content) == 84 + _FACET.itemsize * count:
        corners = np.frombuffer(content, _FACET, count, 84)["corners"].astype(np.float64)
    elif content[:5].lower() == b"solid":
        found = [tuple(map(float, corner.groups())) for corner in _VERTEX.finditer(content)]
        if len(found) % 3:
            raise ValueError(f"it has {len(found)} corners, which are no triangles")
        corners = np.array(found, np.float64).reshape(-1, 3, 3)
    else:
        raise ValueError(f"its size of {len(content)} bytes is not that of {count} triangles")
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def read_obj(content: bytes) -> Mesh:
    """Read the vertices and faces of an OBJ file; everything else in it is left out."""
    vertices: list[tuple[float, float, float]] = []
    faces: list[list[int]] = []
    for number, line in enumerate(content.splitlines(), 1):
        words = line.split()
        if not words or words[0] not in (b"v", b"f"):
            continue
        try:
            if words[0] == b"v":
                x, y, z = (float(word) for word in words[1:4])
                vertices.append((x, y, z))
            else:
                # Counted from 1, or backwards from the vertices so far.
                corners = [int(word.partition(b"/")[0]) for word in words[1:]]
                faces.append([c - 1 if c > 0 else len(vertices) + c if c else -1 for c in corners])
        except ValueError:
            raise ValueError(f"line {number} is no vertex with three numbers and no face") from None
    return np.array(vertices, np.float64).reshape(-1, 3), _triangles(faces)


@dataclass(frozen=True)
class _Element:
    """An element of a PLY file: its properties by name; of a list, the types of count and values."""

    name: str
    count: int
    properties: Mapping[str, tuple[str, ...]]


def read_ply(content: bytes) -> Mesh:
    """Read the vertices and faces of a PLY file, as text or binary."""
    order, elements, start = _header(content)
    reader = _text_rows(content, start) if order == "ascii" else _binary_rows(content, start, _ORDERS[order])
    vertices = np.zeros((0, 3))
    faces: list[list[int]] = []
    for element in elements:
        rows = reader(element)
        if element.name == "vertex":
            if not {"x", "y", "z"} <= element.properties.keys():
                raise ValueError("its vertices have no x, y and z")
            vertices = np.array([[row["x"][0], row["y"][0], row["z"][0]] for row in rows], np.float64)
        elif element.name == "face":
            lists = [name for name, types in element.properties.items() if len(types) == 2]
            key = next((name for name in lists if name in ("vertex_indices", "vertex_index")), None)
            if key is None:
                raise ValueError("its faces have no vertex_indices")
            faces = [[int(corner) for corner in row[key]] for row in rows]
        else:
            for _ in rows:
                pass
    return vertices.reshape(-1, 3), _triangles(faces)


_Row: TypeAlias = Mapping[str, Sequence[float]]
_Reader: TypeAlias = Callable[[_Element], Iterator[_Row]]


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """Return the form, the elements, and where what follows the header begins."""
    end = content.find(b"end_header", 0, 1 << 20)
    newline = content.find(b"\n", end)
    if not content.startswith(b"ply") or end < 0 or newline < 0:
        raise ValueError("it has no whole header")
    order = ""
    elements: list[tuple[str, int, dict[str, tuple[str, ...]]]] = []
    lines = content[:end].decode("ascii", "replace").splitlines()
    if len(lines) > _MOST_HEADER_LINES:
        raise ValueError(f"its header has more than {_MOST_HEADER_LINES} lines")
    for line in lines[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isascii() and words[2].isdigit():
            elements.append((words[1], int(words[2][:20]), {}))
        elif words[:1] == ["property"] and elements and len(words) in (3, 5):
            types = tuple(_TYPES.get(word, "") for word in words[2 if len(words) == 5 else 1 : -1])
            if not all(types) or words[-1] in elements[-1][2]:
                raise ValueError(f"'{line[:40]}' is no property")
            elements[-1][2][words[-1]] = types
        elif words[:1] not in ([], ["comment"], ["obj_info"]):
            raise ValueError(f"'{line[:40]}' stands in its header")
    if order not in _ORDERS:
        raise ValueError(f"its format '{order[:40]}' is none of {', '.join(_ORDERS)}")
    for name, count, properties in elements:
        if not properties or count > len(content) - newline:
            raise ValueError(f"it cannot hold {count} of its element {name[:40]}")
    return order, [_Element(*element) for element in elements], newline + 1


def _text_rows(content: bytes, start: int) -> _Reader:
    lines = iter(content[start:].splitlines())

    def rows(element: _Element) -> Iterator[_Row]:
        read = 0
        for line in islice((line for line in lines if line.strip()), element.count):
            words = iter([float(word) for word in line.split()])
            read += 1
            yield {name: _text_value(words, types) for name, types in element.properties.items()}
        if read < element.count:
            raise ValueError(f"it ends after {read} of {element.count} of its element {element.name[:40]}")

    return rows


def _text_value(words: Iterator[float], types: tuple[str, ...]) -> list[float]:
    count = int(next(words, -1.0)) if len(types) == 2 else 1
    found = list(islice(words, max(count, 0)))
    if len(found) != count:
        raise ValueError("a line of it is too short")
    return found


def _binary_rows(content: bytes, start: int, order: str) -> _Reader:
    place = start

    def rows(element: _Element) -> Iterator[_Row]:
        nonlocal place
        for _ in range(element.count):
            row = {}
            for name, types in element.properties.items():
                count = 1
                if len(types) == 2:
                    count = int(_values(types[0], 1)[0])
                row[name] = _values(types[-1], count)
            yield row

    def _values(kind: str, count: int) -> Sequence[float]:
        nonlocal place
        dtype = np.dtype(order + kind)
        if count < 0 or place + count * dtype.itemsize > len(content):
            raise ValueError("it ends too soon")
        found: list[float] = np.frombuffer(content, dtype, count, place).tolist()
        place += count * dtype.itemsize
        return found

    return rows


def _triangles(faces: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return triangles; a face with four corners becomes two, and one with more is refused."""
    found: list[tuple[int, int, int]] = []
    for face in faces:
        if not 3 <= len(face) <= 4:
            raise ValueError(f"it has a face with {len(face)} corners; divide its faces into triangles")
        if max(face) >= 1 << 31:
            raise ValueError(f"it has a face with the corner {max(face)}")
        found.append((face[0], face[1], face[2]))
        if len(face) == 4:
            found.append((face[0], face[2], face[3]))
    return np.array(found, np.int64).reshape(-1, 3)
