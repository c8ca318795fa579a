"""Comma-separated values: points of a mesh, pixels or points of a record; units and formulas on top."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import Exporter, labels_of, placed, write_rows
from sms_jobs.formats.exporters.formulas import with_formula
from sms_jobs.formats.exporters.record_arrays import texts_of
from sms_jobs.records.fields import Mesh
from sms_jobs.records.quantity import quantities_of


def _save(
    path: Path, labels: list[str], columns: list[NDArray[Any]], places: NDArray[np.intp] | None = None
) -> None:
    """Write columns, or some of their rows, under quoted labels; texts are quoted, what is missing is nan."""
    form = ",".join("%s" if column.dtype.kind == "U" else "%.9g" for column in columns)
    written = [_quoted(column.tolist()) if column.dtype.kind == "U" else column for column in columns]
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(_quoted(labels)) + "\n")
        write_rows(file, written, form, places)


def _quoted(texts: list[str]) -> NDArray[np.str_]:
    return np.array(['"' + text.replace('"', '""') + '"' for text in texts], np.str_)


def write(record: Any, path: Path) -> None:
    """Write the vertices of a mesh and their values, one a line; pixels or points of any other record."""
    if not isinstance(record, Mesh):
        has_images = any(quantity.is_image for quantity in quantities_of(record).values())
        (write_pixels if has_images else write_points)(record, path)
        return
    mesh = placed(record)
    labels = [with_formula(n, label) for n, label in zip(mesh.value_names, labels_of(mesh), strict=True)]
    unit = mesh.unit
    axes = [f"{axis} [{unit}]" for axis, _ in zip(mesh.axes, mesh.vertices.T, strict=False)]
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


def write_points(record: Any, path: Path) -> None:
    """Write what a record has for each of its points, one point a line: names first, then values, vectors.

    Raises
    ------
    InvalidInput
        When the record has no field with one value for each point.
    """
    fields = {
        name: (quantity, getattr(record, name))
        for name, quantity in quantities_of(record).items()
        if isinstance(getattr(record, name), np.ndarray)
    }
    points = next((quantity.axes for quantity, _ in fields.values() if len(quantity.axes) == 1), None)
    if points is None:
        raise InvalidInput(f"a {type(record).__name__} has no values over an image or at points")
    texts = texts_of(record)
    labels, columns = list(texts), list[NDArray[Any]](texts.values())
    for name, (quantity, values) in fields.items():
        if quantity.axes == points:
            parts = {name: values}
        elif quantity.axes == (*points, "component"):
            names = quantity.components or tuple(map(str, range(values.shape[1])))
            parts = {f"{name} {part}": column for part, column in zip(names, values.T, strict=True)}
        elif quantity.axes == ("component", *points):
            names = quantity.components or tuple(map(str, range(len(values))))
            parts = {f"{name} {part}": column for part, column in zip(names, values, strict=True)}
        else:
            continue
        labels += [with_formula(full, f"{full} [{quantity.unit}]") for full in parts]
        columns += list(parts.values())
    _save(path, labels, columns)


EXPORTER = Exporter(
    "csv", "comma-separated values with units and formulas", ".csv", "text/csv", write, (object,)
)
