"""PLY, binary: vertices with their values as scalar properties, and triangles."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from sms_jobs.formats.exporters.exporter import Exporter, faces_of, labels_of
from sms_jobs.records.fields import Mesh

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def _property_names(mesh: Mesh) -> list[str]:
    """Return names without blanks, all different, and none that PLY gives a meaning of its own."""
    taken = {"x", "y", "z"}
    names = []
    for value in mesh.value_names:
        name = "scalar_" + (re.sub(r"\W+", "_", value, flags=re.ASCII).strip("_") or "value")
        while name in taken:
            name += "_"
        taken.add(name)
        names.append(name)
    return names


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values; the units stand in comments."""
    faces = faces_of(mesh)
    names = _property_names(mesh)
    vertices = np.empty(
        len(mesh.vertices), [*((axis, "<f8") for axis in "xyz"), *((name, "<f8") for name in names)]
    )
    for axis, column in zip("xyz", mesh.vertices.T, strict=True):
        vertices[axis] = column
    for name, values in zip(names, mesh.values, strict=True):
        vertices[name] = values
    triangles = np.empty(len(faces), _FACE)
    triangles["count"], triangles["corners"] = 3, faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment positions in mm",
        *(f"comment {n} is {label}" for n, label in zip(names, labels_of(mesh), strict=True)),
        f"element vertex {len(vertices)}",
        *(f"property double {n}" for n in ["x", "y", "z", *names]),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii", errors="replace"))
        file.write(vertices.tobytes())
        file.write(triangles.tobytes())


EXPORTER = Exporter("ply", "PLY binary, with values", ".ply", "model/x-ply", write)
