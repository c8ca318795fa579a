"""What an exporter is given: a mesh or a grid of points, made of a record, with chosen values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import Exporter, PointGrid
from sms_jobs.metrology.geometry.planes import in_space, trace
from sms_jobs.records.field_names import TEXTURE
from sms_jobs.records.fields import Mesh
from sms_jobs.records.quantity import QUANTITY, Axes, LengthUnit, Quantity, quantities_of

_POSITION = "position"


def value_fields(record: Any) -> list[str]:
    """Return the names by which values of a record are chosen."""
    if isinstance(record, Mesh):
        return list(record.value_names)
    return [n for n in quantities_of(record) if isinstance(getattr(record, n), np.ndarray)]


def source_for(
    exporter: Exporter, record: Any, chosen: Sequence[str] = (), texture: NDArray[Any] | None = None
) -> Any:
    """Return what an exporter takes, made of a record.

    Parameters
    ----------
    exporter
        Which is to write.
    record
        Of any class.
    chosen
        Names of the values to keep, as `value_fields` has them; empty for all.
    texture
        (rows, columns), 0 .. 1, of the image that the record is about; None if it is not known.

    Raises
    ------
    InvalidInput
        The record has no such value, or nothing that the format can hold.
    """
    _check(record, chosen)
    if isinstance(record, Mesh):
        if object in exporter.takes or Mesh in exporter.takes:
            return _mesh_with(record, chosen)
        raise InvalidInput(
            f"{exporter.name} takes points in the order of an image and a mesh has none: choose another "
            "record of the file, or the format xyz"
        )
    if object in exporter.takes:
        return _record_with(record, chosen)
    grid = grid_of(record, chosen, texture, exporter.name)
    return grid if PointGrid in exporter.takes else mesh_of(grid, _sigma_of(record))


def _sigma_of(record: Any) -> NDArray[np.float64] | None:
    """Return the standard deviation of positions, (rows, columns), of a record that knows it."""
    covariance = getattr(record, "covariance", None)
    if covariance is None:
        return None
    return np.asarray(np.sqrt(trace(covariance)))


def grid_of(
    record: Any, chosen: Sequence[str] = (), texture: NDArray[Any] | None = None, needed_by: str = "a grid"
) -> PointGrid:
    """Return the points of a record over an image, and its other image fields as values.

    Raises `InvalidInput` when the record has no positions.
    """
    known = quantities_of(record)
    if _POSITION not in known:
        raise InvalidInput(
            f"a {type(record).__name__} has no positions, which {needed_by} needs: choose another record of "
            "the file, a file of the kind merge, or a format for any record: csv, npz, matlab"
        )
    shape = record.position.shape[1:]
    names, units, values = [], [], []
    for name, quantity in known.items():
        field = getattr(record, name)
        if name == _POSITION or (chosen and name not in chosen) or not _over(field, quantity, shape):
            continue
        parts = field.reshape(-1, *shape)
        components = quantity.components or ("",) * len(parts)
        for component, part in zip(components, parts, strict=True):
            names.append(f"{name} {component}".strip())
            units.append(quantity.unit)
            values.append(part)
    stacked = np.stack(values) if values else np.zeros((0, *shape))
    unit: LengthUnit = getattr(record, "unit", "mm")
    axes: Axes = getattr(record, "axes", "XYZ")
    return PointGrid(in_space(record.position), tuple(names), tuple(units), stacked, texture, unit, axes)


def _over(field: Any, quantity: Quantity, shape: tuple[int, ...]) -> bool:
    """Say whether an array is over the image of the positions, one component or several."""
    return (
        isinstance(field, np.ndarray)
        and quantity.is_image
        and field.shape[-2:] == shape
        and (field.ndim == 2 or len(quantity.components) == field.shape[0])
    )


def mesh_of(grid: PointGrid, sigma: NDArray[np.float64] | None = None, step: int = 1) -> Mesh:
    """Return triangles between the neighbouring points of a grid; none across discontinuities and holes.

    Parameters
    ----------
    grid
        Points and values.
    sigma
        (rows, columns) in mm, of the positions; None where it is not known.
    step
        Distance of the vertices in pixels.
    """
    # Imports kernels, which whoever has a mesh already need not wait for.
    from sms_jobs.metrology.surfaces.continuity import continuous_labels
    from sms_jobs.metrology.surfaces.meshing import triangulate_image

    pixels, faces = triangulate_image(continuous_labels(grid.xyz, sigma), step)
    row, column = pixels.T
    names, units = grid.value_names, grid.value_units
    values = np.asarray(grid.values[:, row, column], np.float64)
    if grid.texture is not None and TEXTURE not in names:
        names, units = (*names, TEXTURE), (*units, "1")
        values = np.concatenate([values, np.asarray(grid.texture[row, column], np.float64)[None]])
    vertices = np.ascontiguousarray(grid.xyz[:, row, column].T)
    return Mesh(names, units, vertices, faces, values, grid.unit, axes=grid.axes)


def _check(record: Any, chosen: Sequence[str]) -> None:
    known = value_fields(record)
    for name in chosen:
        if name not in known:
            raise InvalidInput(
                f"a {type(record).__name__} has no field '{name}'; choose among {', '.join(known) or 'none'}"
            )


def _mesh_with(mesh: Mesh, chosen: Sequence[str]) -> Mesh:
    if not chosen:
        return mesh
    places = [mesh.value_names.index(name) for name in chosen]
    return replace(
        mesh,
        value_names=tuple(chosen),
        value_units=tuple(mesh.value_units[k] for k in places),
        values=mesh.values[places],
    )


def _record_with(record: Any, chosen: Sequence[str]) -> Any:
    """Return a record whose arrays that were not chosen are None, which exporters pass over."""
    if not chosen or not is_dataclass(record):
        return record
    left_out: Mapping[str, None] = {
        f.name: None for f in fields(record) if QUANTITY in f.metadata and f.name not in chosen
    }
    return replace(record, **left_out)  # type: ignore[type-var]
