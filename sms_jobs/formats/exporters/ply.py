"""PLY, binary: vertices with their values as scalar properties, grey where there is a texture, triangles."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from sms_jobs.formats.exporters.exporter import (
    ROWS_AT_ONCE,
    Exporter,
    labels_of,
    texture_of,
    with_depth,
)
from sms_jobs.records.fields import Mesh

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_COLOURS = ("red", "green", "blue")


def _property_names(mesh: Mesh) -> list[str]:
    """Return names without blanks, all different, and none that PLY gives a meaning of its own."""
    taken = {"x", "y", "z", *_COLOURS}
    names = []
    for value in mesh.value_names:
        name = "scalar_" + (re.sub(r"\W+", "_", value, flags=re.ASCII).strip("_") or "value")
        while name in taken:
            name += "_"
        taken.add(name)
        names.append(name)
    return names


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values; the units stand in comments, what is missing is NaN."""
    mesh = with_depth(mesh)
    names, texture = _property_names(mesh), texture_of(mesh)
    colours = () if texture is None else _COLOURS
    doubles = ["x", "y", "z", *names]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment positions in {mesh.unit}",
        *(f"comment {n} is {label}" for n, label in zip(names, labels_of(mesh), strict=True)),
        f"element vertex {len(mesh.vertices)}",
        *(f"property double {n}" for n in doubles),
        *(f"property uchar {n}" for n in colours),
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    vertex = np.dtype([*((n, "<f8") for n in doubles), *((n, "u1") for n in colours)])
    columns = (*mesh.vertices.T, *mesh.values)
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii", errors="replace"))
        for start in range(0, len(mesh.vertices), ROWS_AT_ONCE):
            some = slice(start, start + ROWS_AT_ONCE)
            part = np.empty(len(mesh.vertices[some]), vertex)
            for name, column in zip(doubles, columns, strict=True):
                part[name] = column[some]
            for name in colours:
                assert texture is not None
                part[name] = np.rint(255.0 * texture[some])
            file.write(part.tobytes())
        for start in range(0, len(mesh.faces), ROWS_AT_ONCE):
            corners = mesh.faces[start : start + ROWS_AT_ONCE]
            triangles = np.empty(len(corners), _FACE)
            triangles["count"], triangles["corners"] = 3, corners
            file.write(triangles.tobytes())


EXPORTER = Exporter("ply", "PLY binary, with values as scalar fields", ".ply", "model/x-ply", write)
