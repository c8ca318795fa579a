"""Wavefront OBJ: vertices and triangles, without values."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sms_jobs.formats.exporters.exporter import Exporter, faces_of
from sms_jobs.records.fields import Mesh


def write(mesh: Mesh, path: Path) -> None:
    """Write the vertices and triangles of a mesh."""
    faces = faces_of(mesh)
    with path.open("w", encoding="ascii") as file:
        file.write("# surface in mm\n")
        np.savetxt(file, mesh.vertices, fmt="v %.9g %.9g %.9g")
        np.savetxt(file, faces + 1, fmt="f %d %d %d")


EXPORTER = Exporter("obj", "Wavefront OBJ, shape only", ".obj", "model/obj", write)
