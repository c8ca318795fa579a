"""Comma-separated values: points of a mesh or pixels of a record; units and formulas in the header."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import Exporter, labels_of, placed, write_rows
from sms_jobs.formats.exporters.formulas import with_formula
from sms_jobs.records.fields import Mesh
from sms_jobs.records.quantity import XYZ, quantities_of


def _save(
    path: Path, labels: list[str], columns: list[NDArray[Any]], places: NDArray[np.intp] | None = None
) -> None:
    """Write columns, or some of their rows, under quoted labels; what is missing is nan."""
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join('"' + label.replace('"', '""') + '"' for label in labels) + "\n")
        write_rows(file, columns, ",".join(["%.9g"] * len(columns)), places)


def write(record: Any, path: Path) -> None:
    """Write the vertices of a mesh and their values, one a line; the pixels of any other record."""
    if not isinstance(record, Mesh):
        write_pixels(record, path)
        return
    mesh = placed(record)
    labels = [with_formula(n, label) for n, label in zip(mesh.value_names, labels_of(mesh), strict=True)]
    unit = mesh.unit
    axes = [f"{axis} [{unit}]" for axis, _ in zip(XYZ, mesh.vertices.T, strict=False)]
    _save(path, [*axes, *labels], [*mesh.vertices.T, *mesh.values])


def write_pixels(record: Any, path: Path) -> None:
    """Write every image field of a record, one pixel a line; pixels without any value are left out.

    Raises
    ------
    InvalidInput
        When the record has no field over an image.
    """
    labels, columns = [], []
    for name, quantity in quantities_of(record).items():
        values = getattr(record, name)
        if not quantity.is_image or not isinstance(values, np.ndarray):
            continue
        parts = values.reshape(-1, *values.shape[-2:])
        components = quantity.components or tuple(str(i) for i in range(len(parts)))
        for component, part in zip(components, parts, strict=True):
            full = name if values.ndim == 2 else f"{name} {component}"
            labels.append(with_formula(full, f"{full} [{quantity.unit}]"))
            columns.append(part)
    if not columns:
        raise InvalidInput(f"a {type(record).__name__} has no field over an image")
    shape = columns[0].shape
    kept = [(label, part) for label, part in zip(labels, columns, strict=True) if part.shape == shape]
    fields = [part for _, part in kept if part.dtype.kind == "f"]
    known = np.any([np.isfinite(part) for part in fields], axis=0) if fields else np.ones(shape, bool)
    row, column = np.indices(shape, np.int32, sparse=True)
    pixels = [np.broadcast_to(column, shape), np.broadcast_to(row, shape), *(part for _, part in kept)]
    _save(
        path,
        ["column [px]", "row [px]", *(label for label, _ in kept)],
        [part.reshape(-1) for part in pixels],
        np.flatnonzero(known),
    )


EXPORTER = Exporter(
    "csv", "comma-separated values with units and formulas", ".csv", "text/csv", write, (object,)
)
