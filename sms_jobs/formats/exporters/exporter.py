"""What an exporter is, and what all of them ask of a surface."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.geometry.planes import in_space
from sms_jobs.records.field_names import TEXTURE
from sms_jobs.records.fields import Mesh
from sms_jobs.records.quantity import Axes, LengthUnit

ROWS_AT_ONCE = 5_000
"""Points that are turned into bytes at once: a MiB or two, however many there are in all."""
_NUMBERS_AT_ONCE = 2_000
"""Numbers that are turned into text at once: as much."""


@dataclass(frozen=True)
class PointGrid:
    """Points in the order of an image, with values.

    Attributes
    ----------
    xyz
        (3, rows, columns); NaN where there is no point. Z is 0 in the plane of an image.
    value_names, value_units
        Of `values`.
    values
        (values, rows, columns).
    texture
        (rows, columns), 0 for black to 1 for white; None where it is not known.
    unit
        Of `xyz`: mm, or px for an image of which nothing else is known.
    axes
        X, Y, Z of the world, or x, y, z of the specimen.
    """

    xyz: NDArray[np.float64]
    value_names: tuple[str, ...]
    value_units: tuple[str, ...]
    values: NDArray[np.floating]
    texture: NDArray[np.floating] | None = None
    unit: LengthUnit = "mm"
    axes: Axes = "XYZ"

    def valid(self) -> NDArray[np.bool_]:
        """Return where there is a point, (rows, columns); raise `MeasurementFailed` where there is none."""
        known: NDArray[np.bool_] = np.asarray(np.isfinite(self.xyz).all(axis=0))
        if not known.any():
            raise MeasurementFailed("the image has no point with a position: there is nothing to export")
        return known


@dataclass(frozen=True)
class Exporter:
    """A way to write a result for other programs.

    Attributes
    ----------
    name, summary
        As a person chooses it.
    suffix, media_type
        Of the files that it makes.
    write
        Fills the file at a path from one of the classes of `takes`.
    takes
        `Mesh`, `PointGrid`, or `object` for any record.
    """

    name: str
    summary: str
    suffix: str
    media_type: str
    write: Callable[[Any, Path], None]
    takes: tuple[type, ...] = (Mesh,)


def faces_of(mesh: Mesh) -> NDArray[np.int32]:
    """Return the faces of a mesh, (faces, 3); raise `MeasurementFailed` if there is none to write."""
    if len(mesh.faces) == 0:
        raise MeasurementFailed(
            "the mesh has no face, since no square of pixels has values at all of its corners: there is "
            "nothing to export; 'sms data show' of the shape and the displacement says why"
        )
    return mesh.faces


def with_depth(mesh: Mesh) -> Mesh:
    """Return a placed mesh for formats that know no plane: in the plane of an image its Z is 0."""
    mesh = placed(mesh)
    return replace(mesh, vertices=np.ascontiguousarray(in_space(mesh.vertices.T).T))


def placed(mesh: Mesh) -> Mesh:
    """Return a mesh without the vertices that have no position, and the faces that they were corners of.

    Raises `MeasurementFailed` if no face is left.
    """
    known: NDArray[np.bool_] = np.asarray(np.isfinite(mesh.vertices).all(axis=1))
    if not known.all():
        number = np.cumsum(known, dtype=np.int32) - 1
        faces = mesh.faces[known[mesh.faces].all(axis=1)]
        mesh = replace(
            mesh,
            vertices=mesh.vertices[known],
            faces=number[faces].astype(np.int32),
            values=mesh.values[:, known],
            camera=None if mesh.camera is None else mesh.camera[known],
            pixel=None if mesh.pixel is None else mesh.pixel[:, known],
        )
    faces_of(mesh)
    return mesh


def labels_of(mesh: Mesh | PointGrid) -> list[str]:
    """Return the names of values with their units, fit to stand between quotation marks."""
    pairs = zip(mesh.value_names, mesh.value_units, strict=True)
    return [f"{name} [{unit}]".replace('"', "'").replace("\n", " ") for name, unit in pairs]


def texture_of(mesh: Mesh) -> NDArray[np.float64] | None:
    """Return the grey of each vertex, 0 .. 1, black where it is missing; None if the mesh has no texture."""
    if TEXTURE not in mesh.value_names:
        return None
    return grey(mesh.values[mesh.value_names.index(TEXTURE)])


def grey(texture: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return a texture within 0 .. 1; what is missing is black, since colours know no NaN."""
    return np.clip(np.nan_to_num(np.asarray(texture, np.float64), nan=0.0), 0.0, 1.0)


def write_rows(
    stream: TextIO,
    columns: Iterable[NDArray[Any]],
    form: str,
    places: NDArray[np.intp] | None = None,
) -> None:
    """Write columns of equal length as text, a line each by the printf format `form`, in bounded memory.

    With `places`, only the rows at these places.
    """
    line, columns = form + "\n", list(columns)
    width = len(columns)
    count = len(columns[0]) if places is None else len(places)
    rows = max(1, _NUMBERS_AT_ONCE // width)
    for start in range(0, count, rows):
        some = slice(start, start + rows) if places is None else places[start : start + rows]
        part = [column[some].tolist() for column in columns]
        together: list[Any] = [None] * (width * len(part[0]))
        for place, values in enumerate(part):
            together[place::width] = values
        # Many lines by one format take a fifth less time than each by its own.
        stream.write((line * len(part[0])) % tuple(together))
