"""Comma-separated values: points of a mesh, or pixels of any record, with units in the header."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import Exporter, faces_of, labels_of
from sms_jobs.records.fields import Mesh
from sms_jobs.records.quantity import quantities


def _save(path: Path, labels: list[str], columns: list[Any]) -> None:
    """Write columns under quoted labels."""
    header = ",".join('"' + label.replace('"', '""') + '"' for label in labels)
    np.savetxt(path, np.column_stack(columns), "%.9g", ",", header=header, comments="", encoding="utf-8")


def write(mesh: Mesh, path: Path) -> None:
    """Write the vertices of a mesh and their values, one a line; its triangles are left out."""
    faces_of(mesh)
    _save(path, ["X [mm]", "Y [mm]", "Z [mm]", *labels_of(mesh)], [mesh.vertices, *mesh.values])


def write_pixels(record: Any, path: Path) -> None:
    """Write every image field of a record, one pixel a line; pixels without any value are left out.

    Raises
    ------
    InvalidInput
        When the record has no field over an image.
    """
    labels, columns = [], []
    for name, quantity in quantities(type(record)).items():
        values = getattr(record, name)
        if not quantity.is_image or not isinstance(values, np.ndarray):
            continue
        parts = values.reshape(-1, *values.shape[-2:])
        components = quantity.components or tuple(str(i) for i in range(len(parts)))
        for component, part in zip(components, parts, strict=True):
            labels.append(f"{name}{'' if values.ndim == 2 else ' ' + component} [{quantity.unit}]")
            columns.append(part)
    if not columns:
        raise InvalidInput(f"a {type(record).__name__} has no field over an image")
    shape = columns[0].shape
    kept = [(label, part) for label, part in zip(labels, columns, strict=True) if part.shape == shape]
    fields = [part for _, part in kept if part.dtype.kind == "f"]
    known = np.any([np.isfinite(part) for part in fields], axis=0) if fields else np.ones(shape, bool)
    row, column = np.nonzero(known)
    _save(
        path,
        ["column [px]", "row [px]", *(label for label, _ in kept)],
        [column, row, *(part[known] for _, part in kept)],
    )


EXPORTER = Exporter("csv", "comma-separated values, points without triangles", ".csv", "text/csv", write)
