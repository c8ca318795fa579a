"""Reference surfaces from the files of CAD programs: triangles in STL, PLY or OBJ."""

from __future__ import annotations

import hashlib
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.metrology.surfaces.triangle_surface import triangle_surface
from sms_jobs.records.surfaces import ReferenceSurface

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4, "um": 1e-3}
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_READABLE = (".stl", ".ply", ".obj")
_MOST_TRIANGLES = 10_000_000
_EXACT = (".step", ".stp", ".iges", ".igs", ".sldprt", ".catpart", ".x_t", ".prt", ".jt")


def read_reference_surface(path: Path, unit: str = "mm", turn_over: bool = False) -> ReferenceSurface:
    """Read the triangles of a file.

    Parameters
    ----------
    path
        STL, ASCII or binary, PLY, or OBJ; polygons with four corners become two triangles.
    unit
        In which the file counts, one of `UNITS_MM`: none of these formats says it.
    turn_over
        Whether to turn the triangles over, for a file whose triangles face inwards.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It is of another format, damaged, or has no triangle with an area.
    """
    if unit not in UNITS_MM:
        raise InvalidInput(f"the unit of a surface is one of {', '.join(UNITS_MM)}, not '{unit}'")
    if not path.is_file():
        raise NotFound(f"there is no file {path}")
    suffix = path.suffix.lower()
    if suffix in _EXACT:
        raise InvalidInput(
            f"{path.name} holds exact surfaces, which only CAD programs read: save the part there as STL, "
            "with a chord error of a tenth of the tolerance"
        )
    if suffix not in _READABLE:
        raise InvalidInput(f"{path.name} is no surface that can be read: give a {', '.join(_READABLE)} file")
    vertices, faces = _read(path, suffix)
    if len(faces) > _MOST_TRIANGLES:
        raise InvalidInput(
            f"{path.name} has {len(faces):,} triangles and a reference surface takes {_MOST_TRIANGLES:,} at "
            "most: save it with a larger chord error"
        )
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InvalidInput(f"{path.name} has no triangle, or one whose corners are missing: save it again")
    if turn_over:
        faces = faces[:, ::-1]
    vertices = vertices * UNITS_MM[unit]
    # Refuses what cannot be measured against.
    triangle_surface(vertices, faces)
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return ReferenceSurface(
        path.name,
        digest,
        unit,
        turn_over,
        np.ascontiguousarray(vertices),
        np.ascontiguousarray(faces, np.int32),
    )


def _read(path: Path, suffix: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    import meshio

    failures = (meshio.ReadError, ValueError, KeyError, IndexError, TypeError, AssertionError, EOFError)
    try:
        if suffix == ".stl":
            return _read_stl(path.read_bytes())
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
            mesh: Any = (meshio.ply.read if suffix == ".ply" else meshio.obj.read)(path)
    except failures as error:
        reason = " ".join(str(error).split())[:120] or "it is damaged"
        raise InvalidInput(f"{path.name} is no whole {suffix[1:].upper()} file ({reason})") from error
    parts = [np.zeros((0, 3), np.int64)]
    for cells in mesh.cells:
        corners = np.asarray(cells.data, np.int64)
        if cells.type == "triangle":
            parts.append(corners)
        elif cells.type == "quad":
            parts += [corners[:, :3], corners[:, [0, 2, 3]]]
    points = np.asarray(mesh.points, np.float64)
    return points.reshape(-1, 3), np.concatenate(parts)


def _read_stl(content: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read STL of either form; a binary file is known by its size, whatever it begins with."""
    count = int.from_bytes(content[80:84], "little")
    if len(content) >= 84 and len(content) == 84 + _FACET.itemsize * count:
        corners = np.frombuffer(content, _FACET, count, 84)["corners"].astype(np.float64)
    elif content[:5].lower() == b"solid":
        found = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
        corners = np.array(found, np.float64).reshape(-1, 3, 3)
    else:
        raise ValueError(f"its size of {len(content)} bytes is not that of {count} triangles")
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
