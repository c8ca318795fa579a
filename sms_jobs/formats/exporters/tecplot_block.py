"""Tecplot, ASCII, packed by variable: all X, all Y, all Z, then each value (thesis section 4.5.4)."""

from __future__ import annotations

from pathlib import Path

from sms_jobs.formats.exporters.exporter import Exporter, placed, write_rows
from sms_jobs.formats.exporters.tecplot import write_header
from sms_jobs.records.fields import Mesh

_IN_LINE = 8
"""Values of a line: short enough for readers that allow 4000 characters."""


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh and its values; values that are missing are written as NaN."""
    mesh = placed(mesh)
    with path.open("w", encoding="ascii", errors="replace") as file:
        write_header(mesh, "BLOCK", file)
        for column in (*mesh.vertices.T, *mesh.values):
            whole = len(column) // _IN_LINE * _IN_LINE
            if whole:
                write_rows(file, column[:whole].reshape(-1, _IN_LINE).T, " ".join(["%.9g"] * _IN_LINE))
            if whole < len(column):
                rest = len(column) - whole
                write_rows(file, column[whole:, None], " ".join(["%.9g"] * rest))
        write_rows(file, (mesh.faces + 1).T, "%d %d %d")


EXPORTER = Exporter(
    "tecplot-block", "Tecplot ASCII packed by variable, with values", "-block.dat", "text/plain", write
)
