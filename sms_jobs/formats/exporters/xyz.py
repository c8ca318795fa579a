"""XYZ: one point a line, with its values; for programs that read columns of numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sms_jobs.formats.exporters.exporter import (
    Exporter,
    PointGrid,
    labels_of,
    placed,
    write_rows,
)
from sms_jobs.records.fields import Mesh


def write(points: Mesh | PointGrid, path: Path) -> None:
    """Write points that have a position, and behind it their values; what is missing is nan."""
    places, unit = None, points.unit
    if isinstance(points, PointGrid):
        places = np.flatnonzero(points.valid())
        columns = [*points.xyz.reshape(3, -1), *points.values.reshape(len(points.values), -1)]
    else:
        points = placed(points)
        columns = [*points.vertices.T, *points.values]
    # Of a comment line, some readers want two slashes and most skip it.
    title = " ".join(
        name.replace(" ", "_") for name in [f"{a} [{unit}]" for a in points.axes] + labels_of(points)
    )
    with path.open("w", encoding="utf-8") as file:
        file.write(f"// {title}\n")
        write_rows(file, columns, " ".join(["%.9g"] * len(columns)), places)


EXPORTER = Exporter(
    "xyz", "one point a line with its values, no triangles", ".xyz", "text/plain", write, (PointGrid, Mesh)
)
