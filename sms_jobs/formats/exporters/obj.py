"""Wavefront OBJ: vertices, grey where there is a texture, and triangles."""

from __future__ import annotations

from pathlib import Path

from sms_jobs.formats.exporters.exporter import Exporter, texture_of, with_depth, write_rows
from sms_jobs.records.fields import Mesh


def write(mesh: Mesh, path: Path) -> None:
    """Write the vertices and triangles of a mesh; its texture as red, green and blue behind each position."""
    mesh = with_depth(mesh)
    texture = texture_of(mesh)
    with path.open("w", encoding="ascii") as file:
        file.write(f"# surface in {mesh.unit}\n")
        if texture is None:
            write_rows(file, mesh.vertices.T, "v %.9g %.9g %.9g")
        else:
            file.write("# grey is the camera's level, linear, 1 at full scale\n")
            grey = (texture, texture, texture)
            write_rows(file, [*mesh.vertices.T, *grey], "v %.9g %.9g %.9g %.4g %.4g %.4g")
        write_rows(file, (mesh.faces + 1).T, "f %d %d %d")


EXPORTER = Exporter("obj", "Wavefront OBJ: shape, and texture as grey per vertex", ".obj", "model/obj", write)
