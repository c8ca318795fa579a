"""STL, binary: triangles and their normals, without values."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sms_jobs.formats.exporters.exporter import ROWS_AT_ONCE, Exporter, with_depth
from sms_jobs.records.fields import Mesh

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write(mesh: Mesh, path: Path) -> None:
    """Write the triangles of a mesh; normals follow from the order of the corners, zero without area."""
    mesh = with_depth(mesh)
    with path.open("wb") as file:
        file.write(
            f"surface in {mesh.unit}".encode().ljust(80) + np.uint32(len(mesh.faces)).astype("<u4").tobytes()
        )
        for start in range(0, len(mesh.faces), ROWS_AT_ONCE):
            corners = mesh.vertices[mesh.faces[start : start + ROWS_AT_ONCE]]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            length = np.linalg.norm(normal, axis=1, keepdims=True)
            facets = np.zeros(len(corners), _FACET)
            facets["normal"] = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0.0)
            facets["corners"] = corners
            file.write(facets.tobytes())


EXPORTER = Exporter("stl", "STL binary, shape only", ".stl", "model/stl", write)
