"""Tecplot, ASCII, packed by point: one zone of triangles, a line for each vertex (thesis section 4.5.4)."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

from sms_jobs.formats.exporters.exporter import Exporter, labels_of, with_depth, write_rows
from sms_jobs.records.fields import Mesh


def write_header(mesh: Mesh, packing: str, stream: TextIO) -> None:
    """Write title, variables and zone.

    Readers know the coordinates by the bare names X, Y and Z, so their unit stands in the title.
    """
    variables = ", ".join(f'"{name}"' for name in ["X", "Y", "Z", *labels_of(mesh)])
    of = " of the specimen" if mesh.axes == "xyz" else ""
    stream.write(f'TITLE = "shape and displacement, X, Y, Z{of} in {mesh.unit}"\n')
    stream.write(f"VARIABLES = {variables}\n")
    stream.write(
        f'ZONE T="surface", N={len(mesh.vertices)}, E={len(mesh.faces)}, '
        f"DATAPACKING={packing}, ZONETYPE=FETRIANGLE\n"
    )


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values; values that are missing are written as NaN."""
    mesh = with_depth(mesh)
    columns = [*mesh.vertices.T, *mesh.values]
    with path.open("w", encoding="ascii", errors="replace") as file:
        write_header(mesh, "POINT", file)
        write_rows(file, columns, " ".join(["%.9g"] * len(columns)))
        write_rows(file, (mesh.faces + 1).T, "%d %d %d")


EXPORTER = Exporter("tecplot", "Tecplot ASCII packed by point, with values", ".dat", "text/plain", write)
