"""Fields of other programs: results of calculations, read through meshio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.figures import as_png, new_figure
from sms_jobs.formats.foreign_meshes import read_node_fields
from sms_jobs.metrology.arrays import Floats


@dataclass(frozen=True)
class PointField:
    """A field at points: (n, 3) in mm, and its values (n, components)."""

    points: Floats
    values: Floats


def read_point_field(path: Path, name: str | None, scale_mm: float) -> PointField:
    """Read the nodes of a mesh file and a field at them, by name or the only one with three components.

    Parameters
    ----------
    path
        In any format that meshio knows: VTK, VTU, Abaqus, Nastran, Gmsh, Exodus, ...
    name
        Of the data at the nodes.
    scale_mm
        Length of the file's unit in mm, for its nodes and for a displacement alike.

    Raises
    ------
    NotFound
        There is no such file, or no such field in it.
    InvalidInput
        It cannot be read, or has several such fields and none is named.
    """
    nodes, vectors = read_node_fields(path)
    if name is None and len(vectors) > 1:
        raise InvalidInput(
            f"{path} has the fields {', '.join(vectors)} with three components at its nodes: say which "
            "is the displacement as `field`"
        )
    if not vectors:
        raise NotFound(
            f"{path} has no field with three components at its nodes, neither a vector nor three that differ "
            "in X, Y and Z: save it with its displacement"
        )
    chosen = next(iter(vectors)) if name is None else name
    if chosen not in vectors:
        raise NotFound(
            f"{path} has no field '{chosen}' at its nodes; those with three components are "
            f"{', '.join(vectors)}"
        )
    points = np.zeros((len(nodes), 3))
    points[:, : nodes.shape[1]] = nodes
    return PointField(points * scale_mm, vectors[chosen] * scale_mm)


def write_point_field(path: Path, nodes: Floats, triangles: NDArray[np.int32], displacement: Floats) -> None:
    """Write nodes (n, 3) in mm, triangles (m, 3) and the displacement at the nodes in mm as VTU."""
    import meshio

    mesh = meshio.Mesh(nodes, [("triangle", triangles)], point_data={"displacement": displacement})
    mesh.write(path, file_format="vtu")


def draw_difference(points: Floats, difference: Floats, title: str) -> bytes:
    """Draw the components of a difference of displacements (n, 3) over x and y, as PNG (thesis Fig. 72)."""
    figure = new_figure(11.0, 3.8)
    known = np.isfinite(difference).all(axis=1)
    largest = float(np.quantile(np.abs(difference[known]), 0.99)) if known.any() else 1.0
    for column, axis in enumerate("XYZ"):
        axes = figure.add_subplot(1, 3, column + 1)
        drawn = axes.scatter(
            points[known, 0],
            points[known, 1],
            c=difference[known, column],
            s=2.0,
            cmap="RdBu_r",
            vmin=-largest,
            vmax=largest,
            linewidths=0.0,
        )
        axes.set_aspect("equal")
        axes.set_title(f"{axis} [mm]", fontsize="medium")
    figure.colorbar(drawn, ax=figure.axes)
    figure.suptitle(title, fontsize="medium")
    return as_png(figure)
