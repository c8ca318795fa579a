"""VTK unstructured grid in XML, for ParaView: triangles with values, exact, as appended data in base 64."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.exporters.exporter import ROWS_AT_ONCE, Exporter, labels_of, with_depth
from sms_jobs.records.fields import Mesh

_TYPES = {"<f8": "Float64", "<i4": "Int32", "<i8": "Int64", "|u1": "UInt8"}
_TRIANGLE = 5


class _Appended:
    """The arrays of a file: what the XML says of them, and their bytes behind it."""

    def __init__(self) -> None:
        self._arrays: list[NDArray[Any]] = []
        self._offset = 0

    def element(self, name: str, array: NDArray[Any], components: int = 1) -> str:
        """Take an array of (n,) or (n, components) and return the element that announces it."""
        words = f"Name={quoteattr(name)} NumberOfComponents={quoteattr(str(components))}"
        element = (
            f'<DataArray type="{_TYPES[array.dtype.str]}" {words} format="appended" offset="{self._offset}"/>'
        )
        self._arrays.append(array)
        self._offset += 4 * -(-(8 + array.nbytes) // 3)
        return element

    def blocks(self) -> Iterator[bytes]:
        """Yield each array in base 64, some at a time: its size in bytes as 64 bits, then its bytes."""
        for array in self._arrays:
            waiting = np.uint64(array.nbytes).astype("<u8").tobytes()
            for start in range(0, len(array), ROWS_AT_ONCE):
                waiting += array[start : start + ROWS_AT_ONCE].tobytes()
                # Three bytes are four letters.
                whole = len(waiting) // 3 * 3
                yield b64encode(waiting[:whole])
                waiting = waiting[whole:]
            yield b64encode(waiting)


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values; what is missing is NaN."""
    mesh = with_depth(mesh)
    points = mesh.vertices.astype("<f8", copy=False)
    cells = mesh.faces.astype("<i4", copy=False)
    ends = np.arange(3, 3 * len(cells) + 1, 3, dtype="<i8")
    appended = _Appended()
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f"<!-- positions in {mesh.unit} -->",
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<UnstructuredGrid>",
        f'<Piece NumberOfPoints="{len(points)}" NumberOfCells="{len(cells)}">',
        "<Points>",
        appended.element("Points", points, 3),
        "</Points>",
        "<Cells>",
        appended.element("connectivity", cells.reshape(-1)),
        appended.element("offsets", ends),
        appended.element("types", np.full(len(cells), _TRIANGLE, np.uint8)),
        "</Cells>",
        "<PointData>",
        *(
            appended.element(label, values.astype("<f8", copy=False))
            for label, values in zip(labels_of(mesh), mesh.values, strict=True)
        ),
        "</PointData>",
        "</Piece>",
        "</UnstructuredGrid>",
        '<AppendedData encoding="base64">',
    ]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n_").encode())
        file.writelines(appended.blocks())
        file.write(b"\n</AppendedData>\n</VTKFile>\n")


EXPORTER = Exporter("vtu", "VTK unstructured grid in XML, with values", ".vtu", "model/vnd.vtu", write)
