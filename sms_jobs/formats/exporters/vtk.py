"""VTK legacy, binary polygons: for programs that do not read the XML files of VTK."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

import numpy as np

from sms_jobs.formats.exporters.exporter import ROWS_AT_ONCE, Exporter, labels_of, with_depth
from sms_jobs.records.fields import Mesh


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values; what is missing is NaN.

    Names may have no blanks in this format: they are percent-encoded, as VTK itself does.
    """
    mesh = with_depth(mesh)
    with path.open("wb") as file:
        title = f"surface, positions in {mesh.unit}"
        file.write(f"# vtk DataFile Version 3.0\n{title}\nBINARY\nDATASET POLYDATA\n".encode())
        file.write(f"POINTS {len(mesh.vertices)} double\n".encode())
        for start in range(0, len(mesh.vertices), ROWS_AT_ONCE):
            file.write(mesh.vertices[start : start + ROWS_AT_ONCE].astype(">f8").tobytes())
        file.write(f"\nPOLYGONS {len(mesh.faces)} {4 * len(mesh.faces)}\n".encode())
        for start in range(0, len(mesh.faces), ROWS_AT_ONCE):
            corners = mesh.faces[start : start + ROWS_AT_ONCE]
            file.write(np.insert(corners, 0, 3, axis=1).astype(">i4").tobytes())
        if len(mesh.values):
            file.write(f"\nPOINT_DATA {len(mesh.vertices)}\nFIELD values {len(mesh.values)}\n".encode())
        for label, values in zip(labels_of(mesh), mesh.values, strict=True):
            file.write(f"{quote(label, safe='[]')} 1 {len(values)} double\n".encode())
            for start in range(0, len(values), ROWS_AT_ONCE):
                file.write(values[start : start + ROWS_AT_ONCE].astype(">f8").tobytes())
            file.write(b"\n")


EXPORTER = Exporter("vtk", "VTK legacy polygons, binary, with values", ".vtk", "model/vnd.vtk", write)
