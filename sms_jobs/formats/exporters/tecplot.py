"""Tecplot, ASCII: one zone of triangles, a line for each vertex (thesis section 4.5.4).

meshio writes the packing by variable only; that by point is what the thesis's files have and what people
can read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sms_jobs.formats.exporters.exporter import Exporter, faces_of, labels_of
from sms_jobs.records.fields import Mesh


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values; values that are missing are written as NaN.

    Readers know the coordinates by the bare names X, Y and Z, so their unit stands in the title.
    """
    faces = faces_of(mesh)
    variables = ", ".join(f'"{name}"' for name in ["X", "Y", "Z", *labels_of(mesh)])
    with path.open("w", encoding="ascii", errors="replace") as file:
        file.write('TITLE = "shape and displacement, X, Y, Z in mm"\n')
        file.write(f"VARIABLES = {variables}\n")
        file.write(
            f'ZONE T="surface", N={len(mesh.vertices)}, E={len(faces)}, '
            "DATAPACKING=POINT, ZONETYPE=FETRIANGLE\n"
        )
        np.savetxt(file, np.column_stack([mesh.vertices, mesh.values.T]), fmt="%.9g")
        np.savetxt(file, faces + 1, fmt="%d")


EXPORTER = Exporter("tecplot", "Tecplot ASCII, with values", ".dat", "text/plain", write)
