"""VTK unstructured grid in XML, for ParaView: triangles with values, by meshio."""

from __future__ import annotations

from pathlib import Path

import meshio

from sms_jobs.formats.exporters.exporter import Exporter, faces_of, labels_of
from sms_jobs.records.fields import Mesh


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values."""
    grid = meshio.Mesh(
        mesh.vertices,
        [("triangle", faces_of(mesh))],
        point_data=dict(zip(labels_of(mesh), mesh.values, strict=True)),
    )
    meshio.write(path, grid, file_format="vtu")


EXPORTER = Exporter("vtu", "VTK unstructured grid, with values", ".vtu", "model/vnd.vtu", write)
